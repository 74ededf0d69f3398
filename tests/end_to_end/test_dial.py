# SPDX-License-Identifier: Apache-2.0
"""The benchmark of the dial on the toy world: its rows are what each place does, and it goes on where it was cut."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from ssilk_core.errors import SsilkError
from ssilk_core.quality.cost import play_time

OPTIONS = "--model model.safetensors --stage rigged.usda --motions clips --after 2 4 --lead 3 --threads 1"
SOLVERS = ("1 in latents", "2 in latents", "4 in latents", "latent", "refine 4", "hero")


@pytest.fixture(scope="module")
def world(toy, tmp_path_factory):
    folder = tmp_path_factory.mktemp("dial")
    toy.copy(folder)
    (folder / "clips").mkdir()
    for name in ("calm", "wild"):
        toy.write_clip(folder / "clips" / f"{name}.usdc", frames=30)
    index = [{"clip": "calm", "split": "test"}, {"clip": "wild", "split": "flips"}]
    (folder / "clips" / "index.json").write_text(json.dumps(index))
    return folder


@pytest.fixture(scope="module")
def script(world) -> Callable[[str], None]:
    """Run the benchmark in the world, with its options; few frames are timed."""

    def run(options: str) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(world)
            patch.syspath_prepend(str(Path(__file__).parents[2] / "benchmarks"))
            patch.setattr(sys, "argv", ["dial.py", *options.split()])
            dial = __import__("dial")
            brief = partial(play_time, seconds=0.01)
            patch.setattr("helpers.dial_places.play_time", brief)
            patch.setattr("helpers.dial_places.TIMED", 4)
            patch.setattr(dial, "SHOT", 5)
            patch.setattr("ssilk_core.network.latent_solver.elements.EQUATIONS", 128)  # enough for a toy
            dial.main()

    return run


@pytest.fixture(scope="module")
def measured(script, world):
    script(f"errors {OPTIONS} --output dial.json")
    return json.loads((world / "dial.json").read_text())


@pytest.fixture(scope="module")
def few(script, world):
    """Figures of some places, and the options that ask for these."""
    options = f"errors {OPTIONS} --places network game crowd"
    script(f"{options} --output few.json")
    return json.loads((world / "few.json").read_text()), options


@pytest.mark.slow
def test_each_place_is_measured_from_its_own_two_states(measured):
    rows = {(row["split"], row["place"]): row for row in measured["figures"]}
    assert "unfinished" not in measured and len(rows) == len(measured["figures"]) == 2 * 11
    for split in ("test", "flips"):
        network, simulator = rows[split, "network"], rows[split, "simulator"]
        assert 0 < network["distance"]["2"][0] < network["distance"]["4"][0] and network["velocity"][0] > 0
        assert simulator["distance"] == {"2": [0], "4": [0]} and simulator["velocity"] == [0]
        hero, off = rows[split, "hero"], rows[split, "simulator, 1 mm off"]
        assert hero["distance"]["4"][0] < 0.2 * network["distance"]["4"][0]  # it is the simulator, cut short
        assert 0 < off["distance"]["4"][0] < 3e-3 and off["total"] != simulator["total"]
        assert all(len(rows[split, place]["total"]) == 1 and rows[split, place]["lost"] == 0 for place in SOLVERS)


def test_what_was_cut_off_goes_on(few, script, world):
    """Rows that are there stay as they are; the missing place alone is measured, to the same figures."""
    measured, options = few
    cut = {**measured, "unfinished": "yes"}
    cut["figures"] = [
        {**row, "total": [7.0]} if row["place"] == "game" else row
        for row in measured["figures"]
        if row["place"] != "crowd"
    ]
    (world / "cut.json").write_text(json.dumps(cut))
    script(f"{options} --output cut.json")
    found = json.loads((world / "cut.json").read_text())
    assert "unfinished" not in found and len(found["figures"]) == len(measured["figures"])
    for row, known in zip(found["figures"], measured["figures"]):
        if row["place"] == "game":
            assert row["total"] == [7.0]
        else:
            assert row["distance"]["4"] == pytest.approx(known["distance"]["4"], rel=1e-3)


def test_a_place_that_was_cut_off_between_its_splits_is_measured_in_both(few, script, world):
    measured, options = few
    cut = {**measured, "unfinished": "yes"}
    gone = (("flips", "crowd"), ("flips", "simulator, 1 mm off"))
    cut["figures"] = [row for row in measured["figures"] if (row["split"], row["place"]) not in gone]
    (world / "between.json").write_text(json.dumps(cut))
    script(f"{options} --output between.json")
    found = json.loads((world / "between.json").read_text())
    names = [(row["split"], row["place"]) for row in found["figures"]]
    assert "unfinished" not in found and names == [(row["split"], row["place"]) for row in measured["figures"]]


@pytest.mark.slow
def test_times_are_kept_beside_the_errors(measured, script, world):
    path = world / "times.json"
    path.write_text(json.dumps(measured))
    script(f"times {OPTIONS} --shots 2 --output {path.name}")
    found = json.loads(path.read_text())
    assert found["figures"] == measured["figures"] and found["command"] == measured["command"]
    times = {time["place"]: time for time in found["times"]}
    assert set(times) == {row["place"] for row in measured["figures"]} - {"simulator, 1 mm off"}
    assert {time["device"] for time in found["times"]} == {"cpu"}
    assert all(time["milliseconds"] > 0 for time in found["times"])
    assert {place for place, time in times.items() if time["shots"] != 2} == {"refine 4"}


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ("errors", "--motions: no folder"),
        (f"errors {OPTIONS} --windows 0", "0 windows"),
        (f"errors {OPTIONS} --splits inertia", "none of the splits inertia is chosen"),
        (f"errors {OPTIONS} --after 40", "test: its clips are too short"),
    ],
)
def test_what_cannot_be_measured_is_refused(script, options, complaint):
    with pytest.raises(SystemExit, match=complaint) as caught:
        script(f"{options} --output refused.json")
    assert isinstance(caught.value.__cause__, SsilkError)
