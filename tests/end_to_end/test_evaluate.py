# SPDX-License-Identifier: Apache-2.0
"""`ssilk evaluate` on the toy world: its tables, its file, the simulator's shots beside it, and what is refused."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace
from functools import partial
from importlib.metadata import version

import pytest
from pxr import Usd

from ssilk_core.cli import main
from ssilk_core.files import sha256
from ssilk_core.network.checkpoint import load_model, save_model
from ssilk_core.quality.evaluation import asked
from ssilk_core.quality.evaluation.kept_parts import KeptParts
from ssilk_core.quality.evaluation.record import recorded

WORLD = "--stage rigged.usda --motions clips"
QUICK = f"{WORLD} --no-probes"
INDEX = [{"clip": "brief", "split": "valid", "tags": ["inertia"]}, {"clip": "turn", "split": "flips", "tags": []}]


@pytest.fixture(autouse=True)
def loops_are_brief(monkeypatch):
    """Two seconds of them show what a minute would."""
    monkeypatch.setattr(asked, "EvaluationOptions", partial(asked.EvaluationOptions, loop=60))


@pytest.fixture
def world(toy, tmp_path, monkeypatch):
    toy.copy(tmp_path)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "clips").mkdir()
    toy.write_clip(tmp_path / "clips" / "brief.usda", frames=6)
    toy.write_clip(tmp_path / "clips" / "turn.usda", frames=20, fps=60.0)
    (tmp_path / "index.json").write_text(json.dumps(INDEX))
    return tmp_path


def evaluated(words: str) -> int:
    return main(["evaluate", "model.safetensors", *shlex.split(words)])


def test_figures_by_split_are_shown_and_written(world, capsys):
    (world / "index.json").write_text(json.dumps([*INDEX, {"clip": "brief", "split": "train", "tags": []}]))
    assert evaluated(f"{WORLD} --index index.json -o out/figures.json") == 0
    shown = capsys.readouterr()
    parts = shown.out.count("| garment")  # eight tables, the wide ones in parts
    assert parts > 8 and shown.out.count("| ssilk ") == 3 * parts  # no simulator was named
    assert max(map(len, shown.out.splitlines())) <= 118
    document = json.loads((world / "out" / "figures.json").read_text())
    assert document["models"] == {"model.safetensors": sha256("model.safetensors")} and document["units"] == "SI"
    assert document["versions"]["libigl"] == version("libigl")  # which counts what intersects
    rows = {(row["method"], row["split"]): row["figures"] for row in document["figures"]}
    assert rows.keys() == {(m, s) for m in ("LBS", "ssilk") for s in ("valid", "inertia", "flips")}
    assert rows["ssilk", "valid"] == rows["ssilk", "inertia"] and rows["ssilk", "flips"]["frames"] == 10
    found = rows["ssilk", "valid"]
    assert (
        found["total"] == pytest.approx(sum(found["terms"].values())) and found["pose_novelty"]["mean_distance"] < 0.1
    )
    assert {row["garment"] for row in document["figures"]} == {"Skirt"} and found["loop_drift"]["clips"] == 1
    assert found["settling"]["stops"] == document["options"]["stops"] == 2
    assert 0 < found["closed_loop"]["median_radius"] <= found["closed_loop"]["max_radius"]


@pytest.fixture
def stopped(world, monkeypatch, capsys):
    """figures.json of a run that was stopped after a row; return its command, and the takes measured since."""
    words, measured, out = f"{QUICK} --index index.json -o figures.json", [], world / "figures.json"

    def interrupted(*args):
        if out.exists() and not measured:
            raise KeyboardInterrupt
        return recorded(*args)

    with monkeypatch.context() as patch:
        patch.setattr("ssilk_core.quality.evaluation.measured.recorded", interrupted)
        assert evaluated(words) == 130
    assert (
        "figures.json: 2 rows are kept, and parts of the next; other rows are missing; the same command"
        in capsys.readouterr().err
    )

    def counted(*args):
        measured.append(args)
        return recorded(*args)

    monkeypatch.setattr("ssilk_core.quality.evaluation.measured.recorded", counted)
    return words, measured


def test_a_run_that_was_stopped_goes_on(world, stopped, capsys):
    """Its file says that it is unfinished, and the rest of the rows make it what an uninterrupted run writes."""
    words, measured = stopped
    path = world / "figures.json"
    begun = json.loads(path.read_text())
    assert [(row["method"], row["split"]) for row in begun["figures"]] == [("LBS", "valid"), ("LBS", "inertia")]
    assert "the same command, given again" in begun["unfinished"]
    assert main(["report", "model.safetensors", "--figures", "figures.json", "-o", "report.html"]) == 0
    assert "<h2>Evaluation, unfinished</h2>" in (world / "report.html").read_text()

    (world / "elsewhere").mkdir()
    (world / "elsewhere" / "model.safetensors").write_bytes((world / "model.safetensors").read_bytes())
    capsys.readouterr()
    assert main(["evaluate", "elsewhere/model.safetensors", *words.split(), "--json"]) == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    said = [event["text"] for event in events if event["event"] == "message"]
    assert said == ["figures.json: 2 rows were measured before and are taken over; the others are measured"]
    progress = [(event["done"], event["total"]) for event in events if event["event"] == "progress"]
    assert progress == [(2, 4), (3, 4), (4, 4)] and len(measured) == 3
    document = json.loads(path.read_text())
    assert "unfinished" not in document and document["figures"] == events[-1]["detail"]["figures"]

    assert evaluated(words.replace("figures.json", "whole.json")) == 0
    whole = json.loads((world / "whole.json").read_text())
    assert {**document, "models": whole["models"]} == {
        **whole,
        "figures": [{**row, "model": row["model"] and "elsewhere/model.safetensors"} for row in whole["figures"]],
    }


@pytest.mark.slow
def test_a_run_that_is_cut_again_and_again_comes_to_the_same_figures(world, monkeypatch, capsys):
    """It is cut after every third part: records, stops, loops, steps of simulations, single steps."""
    words = f"{WORLD} --index index.json --solver -o"
    assert evaluated(f"{words} whole.json") == 0
    kept: list[str] = []
    put = KeptParts.put

    def cut(self, name, part):
        put(self, name, part)
        kept.append(json.dumps([*self.within, name]))
        if len(kept) % 3 == 0:
            raise KeyboardInterrupt

    monkeypatch.setattr(KeptParts, "put", cut)
    monkeypatch.setattr("ssilk_core.quality.evaluation.kept_parts.EVERY", 0.0)
    parts, runs = world / "cut.json.parts", 1
    while (code := evaluated(f"{words} cut.json")) == 130:
        assert parts.is_file() and len(kept) == 3 * runs
        runs += 1
    assert code == 0 and runs > 5 and not parts.exists()
    assert {json.loads(name)[2] for name in kept} == {"records", "stops", "loops", "solver"}
    repeated = {name for name in kept if kept.count(name) > 1}
    assert all(json.loads(name)[-1] == "windows" for name in repeated)  # whose states follow each other
    document, whole = (json.loads((world / name).read_text()) for name in ("cut.json", "whole.json"))
    assert document == whole and any(row["figures"]["solver"] for row in whole["figures"])


def test_a_file_in_the_place_of_parts_stays(world, stopped, capsys):
    words, _ = stopped
    parts = world / "figures.json.parts"
    assert parts.is_file()
    parts.write_text("notes")
    assert evaluated(words) == 2
    assert "figures.json.parts: not what a measurement keeps" in capsys.readouterr().err
    assert parts.read_text() == "notes"


def test_parts_of_other_inputs_are_begun_anew(world, stopped, capsys):
    """Also where no row was finished."""
    words, measured = stopped
    (world / "figures.json").unlink()
    _renoted(world / "model.safetensors")
    assert evaluated(words) == 0 and len(measured) == 4
    assert "warning: figures.json.parts: begun anew, its parts are of other inputs\n" in capsys.readouterr().err
    assert not (world / "figures.json.parts").exists()


def test_a_finished_file_is_taken_over_as_a_whole(world, stopped, capsys):
    words, measured = stopped
    assert evaluated(words) == 0
    shown, written, count = capsys.readouterr().out, (world / "figures.json").read_bytes(), len(measured)
    assert evaluated(words) == 0
    again = capsys.readouterr()
    assert again.out == shown and "6 rows were measured before and are taken over; it is complete" in again.err
    assert (world / "figures.json").read_bytes() == written and len(measured) == count


@pytest.mark.parametrize(
    ("change", "other"),
    [
        (lambda world: (world / "index.json").write_text(json.dumps(INDEX[:1])), "motions, splits"),
        (lambda world: (world / "clips" / "turn.usda").write_bytes((world / "clips" / "brief.usda").read_bytes()),
         "motions"),
        (lambda world: _renoted(world / "model.safetensors"), "models"),
    ],
)  # fmt: skip
def test_a_file_of_other_inputs_is_begun_anew(world, stopped, capsys, change, other):
    words, _ = stopped
    change(world)
    assert evaluated(words) == 0
    assert f"warning: figures.json: begun anew, its figures are of other {other}\n" in capsys.readouterr().err
    assert "unfinished" not in json.loads((world / "figures.json").read_text())


def test_rows_of_a_version_that_measured_less_are_begun_anew(world, stopped, capsys):
    words, measured = stopped
    document, count = json.loads((world / "figures.json").read_text()), len(measured)
    for row in document["figures"]:
        del row["figures"]["closed_loop"]
    (world / "figures.json").write_text(json.dumps(document))
    assert evaluated(words) == 0
    what = "another version measured its figures ('figures.closed_loop' is missing)"
    assert f"warning: figures.json: begun anew, {what}\n" in capsys.readouterr().err
    written = json.loads((world / "figures.json").read_text())
    assert "unfinished" not in written and all("closed_loop" in row["figures"] for row in written["figures"])
    assert len(measured) > count + 2  # the known rows, too


def test_a_file_of_something_else_stays(world, capsys):
    for text in ('{"points": []}', '{"figures": [{"garment": "Skirt"}]}', "[]", "{"):
        (world / "figures.json").write_text(text)
        assert evaluated(f"{QUICK} -o figures.json") == 2
        assert "figures.json: not figures of 'ssilk evaluate'" in capsys.readouterr().err
        assert (world / "figures.json").read_text() == text


def _renoted(path) -> None:
    """Change the metadata of a model, and nothing that it computes."""
    file = load_model(path)
    save_model(path, replace(file, provenance={**file.provenance, "note": "again"}))


def test_poses_of_the_index_that_were_trained_on_are_near(world, capsys):
    """The clip itself is its own nearest neighbour; without it poses are some way off."""
    found = []
    for clip in ("brief", "turn"):
        (world / "index.json").write_text(json.dumps([*INDEX, {"clip": clip, "split": "train", "tags": []}]))
        assert evaluated(f"{QUICK} --index index.json --json --clips turn") == 0
        event = json.loads(capsys.readouterr().out.splitlines()[-1])
        found += [
            row["figures"]["pose_novelty"]["mean_distance"]
            for row in event["detail"]["figures"]
            if row["method"] == "ssilk"
        ]
    assert found[0] > 0.001 and found[1] < 0.2 * found[0]


def test_the_simulators_shots_are_the_reference(world, capsys):
    words = (
        "simulate rigged.usda --motion clips/brief.usda --points --no-body --tolerance 0.3 -o ref/Skirt/brief.usdc"
    )
    assert main(words.split()) == 0
    assert evaluated(f"{QUICK} --reference ref --json") == 0
    event = json.loads(capsys.readouterr().out.splitlines()[-1])
    rows = {row["method"]: row["figures"] for row in event["detail"]["figures"]}
    assert (rows["simulator"]["frames"], rows["LBS"]["frames"], rows["LBS"]["reference"]["frames"]) == (6, 16, 6)
    # The simulator minimises what is measured: it is lower than cloth that does nothing, and moves elsewhere.
    assert rows["LBS"]["reference"]["total_excess"] > 0 and rows["LBS"]["reference"]["position_error"] > 0.001
    assert rows["simulator"]["total"] == pytest.approx(rows["LBS"]["reference"]["reference_total"])
    assert rows["simulator"]["reference"] is None
    assert rows["ssilk"]["settling"] is None and rows["ssilk"]["loop_drift"] is None


def test_only_points_are_a_reference(world, capsys):
    """What was fitted to points is off them, so that it is refused; points of a refined bake are taken."""
    motion = "--stage rigged.usda --motion clips/brief.usda --no-body"
    points = f"bake model.safetensors {motion} --refine 1 --refined-output points -o points/Skirt/brief.usda"
    refined = f"bake model.safetensors {motion} --refine 1 -o refined/Skirt/brief.usda"
    skinned = f"skin points/Skirt/brief.usda {motion} -o skinned/Skirt/brief.usda"
    for command in (points, refined, skinned):
        assert main(command.split()) == 0
    capsys.readouterr()
    for folder in ("refined", "skinned"):
        assert evaluated(f"{QUICK} --clips brief --reference {folder}") == 2
        complaint = f"{folder}/Skirt/brief.usda: joints and blendshapes, which are millimetres off what was simulated"
        assert complaint in capsys.readouterr().err
    assert evaluated(f"{QUICK} --clips brief --reference points --json") == 0
    event = json.loads(capsys.readouterr().out.splitlines()[-1])
    rows = {row["method"]: row["figures"] for row in event["detail"]["figures"]}
    assert rows["simulator"]["frames"] == 6 and rows["ssilk"]["reference"]["position_error"] > 0


def test_several_models_of_a_garment_share_its_table(world, capsys):
    (world / "again.safetensors").write_bytes((world / "model.safetensors").read_bytes())
    assert evaluated(f"again.safetensors {QUICK} --clips brief") == 0
    lines = [line.split("|")[3].strip() for line in capsys.readouterr().out.split("\n\n")[0].splitlines()[2:]]
    assert lines == ["LBS", "ssilk (model)", "ssilk (again)"]


def test_models_whose_files_have_one_name_are_told_apart_and_given_twice_refused(world, capsys):
    (world / "other").mkdir()
    file = load_model(world / "model.safetensors")
    halved = {name: (0.5 * value).astype(value.dtype) for name, value in file.parameters.items()}
    save_model(world / "other" / "model.safetensors", replace(file, parameters=halved))
    assert evaluated(f"other/model.safetensors {QUICK} --clips brief --json") == 0
    event = json.loads(capsys.readouterr().out.splitlines()[-1])
    totals = {row["method"]: row["figures"]["total"] for row in event["detail"]["figures"]}
    assert [*totals] == ["LBS", "ssilk (model)", "ssilk (other/model)"] and len({*totals.values()}) == 3
    assert evaluated(f"model.safetensors {QUICK} --clips brief") == 2
    assert "several methods are called ssilk (model)" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ("--stage rigged.usda --motions nowhere", "nowhere: there is no such file or folder"),
        (f"{QUICK} --clips brief walk", "1 clips are missing (walk)"),
        (f"{QUICK} --index index.json --clips walk", "no clip of valid, test, inertia, flips is chosen"),
        (f"{QUICK} --index model.safetensors", "no index of clips"),
        (f"{QUICK} --reference nowhere", "nowhere: there is no such folder"),
        (f"{QUICK} --reference wrong", "brief.usda: 60 frames per second; the model steps at 30"),
        (f"{QUICK} -o figures.txt", "not a name for figures"),
        (f"{QUICK} -o index.json --index index.json", "output is also an input"),
        ("--stage clip.usda --motions clips", "there is no SkelRoot"),
    ],
)
def test_what_cannot_be_done_is_refused_in_one_sentence(world, capsys, words, complaint):
    (world / "wrong").mkdir()
    shot = Usd.Stage.Open("shot.usda")
    shot.SetTimeCodesPerSecond(60.0)
    shot.Export("wrong/brief.usda")
    assert evaluated(words) == 2
    assert complaint in capsys.readouterr().err
