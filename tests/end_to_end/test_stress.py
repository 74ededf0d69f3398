# SPDX-License-Identifier: Apache-2.0
"""ssilk stress, from a model and a stage to a table and a file of figures."""

import json

from ssilk_core.cli import main


def stress(toy, *words: str) -> int:
    files = [str(toy.folder / "model.safetensors"), "--stage", str(toy.folder / "rigged.usda")]
    return main(["stress", *files, "--quick", *words])


def test_figures_of_every_case_that_was_asked_for(toy, tmp_path, capsys):
    words = ("--only", "motion: NaN", "upside", "precision: float16", "-o", str(tmp_path / "out.json"))
    assert stress(toy, *words, "--json") == 0
    document = json.loads((tmp_path / "out.json").read_text())
    found = {outcome["name"]: outcome for outcome in document["outcomes"]}
    assert len(found) == 3 and document["inputs"]["quick"] and document["model"] == "model.safetensors"
    assert found["NaN in frame 7"]["verdict"] == "refuses"
    assert found["upside down"]["measured"]["extent"]["finite"]
    assert 0 < found["float16"]["measured"]["error"] < 0.2
    told = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    texts = [event["text"] for event in told if event["event"] == "message"]
    assert sum(line.startswith("| motion: ") for text in texts for line in text.splitlines()) == 2
    left = [(event["done"], event["seconds_left"]) for event in told if event["event"] == "progress"]
    assert left[0] == (0, None) and left[3] == (3, 0) and left[1][1] > left[2][1] > 0


def test_an_interrupted_run_goes_on(toy, tmp_path, capsys, monkeypatch):
    from ssilk_core.quality.stress.cases import Case

    output, run, ran = tmp_path / "out.json", Case.run, []

    def interrupted(case, subject):
        if len(ran) == 1:
            raise KeyboardInterrupt
        ran.append(case.label)
        return run(case, subject)

    words = ("--only", "motion: NaN", "upside", "-o", str(output))
    with monkeypatch.context() as patch:
        patch.setattr(Case, "run", interrupted)
        assert stress(toy, *words) == 130
    before = json.loads(output.read_text())
    assert "unfinished" in before and [row["name"] for row in before["outcomes"]] == ["upside down"]
    assert "1 rows are kept" in capsys.readouterr().err
    assert stress(toy, *words) == 0
    after = json.loads(output.read_text())
    assert "unfinished" not in after and after["outcomes"][0] == before["outcomes"][0]
    assert [row["name"] for row in after["outcomes"]] == ["upside down", "NaN in frame 7"]
    assert "the others are measured" in capsys.readouterr().err
    assert stress(toy, "--only", "precision: float64", "-o", str(output)) == 0  # other cases join those in the file
    assert len(json.loads(output.read_text())["outcomes"]) == 3


def test_a_motion_can_be_given(toy, tmp_path):
    figures = {}
    for name, words in (("own", ()), ("given", ("--motion", str(toy.folder / "clip.usda")))):
        assert stress(toy, *words, "--only", "motion: upside", "-o", str(tmp_path / name)) == 0
        (figures[name],) = json.loads((tmp_path / name).read_text())["outcomes"]
    assert figures["own"]["measured"]["extent"] != figures["given"]["measured"]["extent"]


def test_what_does_not_fit_is_refused_in_one_sentence(toy, tmp_path, capsys):
    assert stress(toy, "--only", "weather") == 2
    assert "no case contains weather" in capsys.readouterr().err
    assert stress(toy, "-o", str(toy.folder / "model.safetensors")) == 2
    assert "the output is also an input" in capsys.readouterr().err
    assert main(["stress", str(tmp_path / "none.safetensors"), "--stage", str(toy.folder / "rigged.usda")]) == 2
    assert "there is no such model file" in capsys.readouterr().err
