# SPDX-License-Identifier: Apache-2.0
"""The paper's tables on the toy world: models and baselines side by side, seeds together, one setting at a time."""

from __future__ import annotations

import json
import shlex
import sys
from collections import Counter
from dataclasses import replace
from itertools import count
from pathlib import Path

import pytest

from benchmarks.baselines.files import save_baseline
from benchmarks.baselines.networks import BaselineConfig, baseline
from ssilk_core.network.checkpoint import load_model, save_model
from ssilk_core.network.schemes import SCHEMES

WORLD = "--stage rigged.usda --motions clips --index index.json --threads 1"


@pytest.fixture
def world(toy, tmp_path, monkeypatch):
    toy.copy(tmp_path)
    monkeypatch.chdir(tmp_path)
    for name, frames in (("brief", 10), ("turn", 8)):
        (tmp_path / "clips").mkdir(exist_ok=True)
        toy.write_clip(tmp_path / "clips" / f"{name}.usdc", frames=frames)
    index = [{"clip": "brief", "split": "valid", "tags": ["inertia"]}, {"clip": "turn", "split": "flips"}]
    (tmp_path / "index.json").write_text(json.dumps(index))
    file = load_model("model.safetensors")
    for batch in (2, 4):
        train = {**file.provenance["train"], "batch": batch}
        save_model(tmp_path / "models" / f"{batch}.safetensors", replace(file, provenance={"train": train}))
    ncs = baseline(file.scene, BaselineConfig(method="ncs"), file.joints)
    save_baseline(tmp_path / "ncs.safetensors", ncs, file.fabric, {"train": {"rotated_fraction": 0.5}})
    return tmp_path


@pytest.fixture
def made(world, monkeypatch, capsys):
    """Make a table as its command does; return the lines that it prints and the figures that it writes."""
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "benchmarks")
    import tables
    from helpers import paper_schemes, reports

    for name, scheme in paper_schemes.PAPER_SCHEMES.items():
        monkeypatch.setitem(SCHEMES, name, scheme)  # what the command registers goes with the test
    monkeypatch.setattr(reports, "RESULTS", world)

    def make(words: str) -> tuple[list[list[str]], object]:
        monkeypatch.setattr(sys, "argv", ["tables.py", *shlex.split(words)])
        capsys.readouterr()
        tables.main()
        name, lines = words.split()[0], capsys.readouterr().out.splitlines()
        (world / "shown.md").write_text("\n".join(lines))
        cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines if line.startswith("|")]
        return [cells[0], *cells[2:]], json.loads((world / f"{name}.json").read_text())["measured"]

    return make


def test_methods_stand_side_by_side_and_seeds_together(made, world):
    (header, *lines), figures = made(f"table1 models ncs.safetensors {WORLD}")
    assert (
        header[:4] == ["garment", "method", "valid: L_tot [J]", "valid: vertices inside the body"]
        and len(header) == 14
    )
    assert [line[:2] for line in lines] == [["Skirt", "LBS"], ["Skirt", "ssilk"], ["Skirt", "ncs*"]]
    assert "±" in lines[1][2] and "±" not in lines[2][2]  # two models are seeds of one method
    found = {(row["method"], row["split"]): row for row in figures["figures"]}
    assert len(found["ssilk", "flips"]["total"]) == 2 and len(found["ncs*", "flips"]["collisions"]) == 1
    assert len(found["ssilk", "flips"]["intersections_mean"]) == 2 == len(found["ssilk", "valid"]["total"])
    assert "total_excess" not in found["ssilk", "flips"]  # there is no simulator
    assert Counter(training["method"] for training in figures["trainings"]) == {"ssilk": 2, "ncs*": 1}
    assert "- ssilk's total is lower than ncs*'s in" in (world / "shown.md").read_text()


def test_tables_of_records_are_those_of_their_models(made, world):
    lines, _ = made(f"table1 models ncs.safetensors {WORLD}")
    swept, _ = made(f"ablations models {WORLD}")
    sys.argv = ["tables.py", *shlex.split(f"record models ncs.safetensors {WORLD} -o records/all.json")]
    import tables

    tables.main()
    sys.argv = ["tables.py", *shlex.split(f"record models {WORLD} -o skirts.json")]
    tables.main()
    assert made("table1 records")[0] == lines
    assert made("ablations skirts.json")[0] == swept
    assert "cpu" in json.loads((world / "ablations.json").read_text())["hardware"]


def test_totals_are_of_whole_clips_and_the_simulator_of_sequences():
    from helpers.records import with_reference

    def row(sequence: int | None, total: float, errors: dict | None, method: str = "ssilk (a)") -> dict:
        figures = {"total": total, "reference": errors}
        return {"model": "x/a.safetensors", "garment": "Cape", "method": method, "split": "valid",
                "sequence": sequence, "figures": figures}  # fmt: skip

    found = with_reference([row(None, 1.0, None), row(64, 2.0, {"total_excess": 0.5}, "ssilk")])
    assert [item["figures"] for item in found] == [{"total": 1.0, "reference": {"total_excess": 0.5}}]
    assert with_reference([row(64, 2.0, {"total_excess": 0.5})])[0]["figures"]["total"] == 2.0


def test_everything_is_what_evaluate_tells(made, world):
    _, figures = made(f"evaluate models/2.safetensors {WORLD} --loop 1")
    # Energies, skin, intersections, motion, closed loop, stops, loops.
    assert (world / "shown.md").read_text().count("| garment |") == 7
    assert figures[-1]["figures"]["settling"]["stops"] == 2 and figures[-1]["figures"]["loop_drift"]["clips"] == 1


def test_one_setting_at_a_time(made, world):
    (_, *lines), figures = made(f"ablations models {WORLD}")
    assert [line[:2] for line in lines] == [["batch", "2"], ["batch", "4"]]  # nothing else has several values
    assert [row["value"] for row in figures["total"]] == ["2", "4"] and figures["garment"] == "Skirt"
    assert all(len(row["flips"]) == 1 for row in figures["total"])


def test_settings_vary_about_what_most_models_have(made):
    from helpers.sweeps import alone

    told = {
        "usual": {"batch": 32, "window": 6}, "again": {"batch": 32, "window": 6},
        "small": {"batch": 8, "window": 6}, "long": {"batch": 32, "window": 16},
    }  # fmt: skip
    assert alone(told, "batch") == {8: ["small"], 32: ["usual", "again"]}
    assert alone(told, "window") == {6: ["usual", "again"], 16: ["long"]}


def test_single_frames_are_timed(made, monkeypatch):
    """By a clock whose ticks grow by two: what comes after a network takes that much longer than its end."""
    from helpers import single_frames

    ticks = count()
    monkeypatch.setattr(single_frames, "now", lambda _: float(next(ticks) ** 2))
    (_, *lines), figures = made(f"table3 models/2.safetensors ncs.safetensors {WORLD} --clip brief --frames 3")
    assert [line[0] for line in lines] == ["2", "ncs"]
    assert [times["full"][0] - times["model"][0] for times in figures.values()] == [2.0, 2.0]


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ("table2 models", "no simulator among the figures"),
        ("record models", "no --output"),
        ("ablations ncs.safetensors", "ncs is a baseline"),
        ("table1 clips", "no model and no record"),
        ("table3 nothing.safetensors", "no such model file"),
    ],
)
def test_what_cannot_be_made_is_refused_in_one_sentence(made, words, complaint):
    with pytest.raises(SystemExit, match=f"error: .*{complaint}"):
        made(f"{words} {WORLD}")
