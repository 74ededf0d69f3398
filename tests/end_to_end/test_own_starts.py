# SPDX-License-Identifier: Apache-2.0
"""The benchmarks of methods side by side on the toy world: distances from their own starts, and pictures."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ssilk_core.delivery.view.panels import GAP
from ssilk_core.errors import SsilkError
from ssilk_core.network.checkpoint import load_model, save_model

PLACE = "--stage rigged.usda --threads 1"


@pytest.fixture
def world(toy, tmp_path, monkeypatch):
    toy.copy(tmp_path)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "clips").mkdir()
    for name, frames in (("long", 14), ("brief", 6)):
        toy.write_clip(tmp_path / "clips" / f"{name}.usdc", frames=frames)
    index = [{"clip": "long", "split": "test"}, {"clip": "brief", "split": "flips"}]
    (tmp_path / "clips" / "index.json").write_text(json.dumps(index))
    shutil.copy("model.safetensors", "other.safetensors")
    return tmp_path


@pytest.fixture
def script(world, monkeypatch) -> Callable[[str, str], None]:
    """Run a benchmark by name, with its options."""
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "benchmarks")

    def run(name: str, options: str) -> None:
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *options.split()])
        __import__(name).main()

    return run


@pytest.mark.slow
def test_methods_are_measured_from_their_own_starts(script, world, capsys):
    """Two models that are one: every window and every seed tells the same, and skinning stands beside them."""
    script("own_starts", f"--model model.safetensors other.safetensors {PLACE} --motions clips --windows 2 "
           "--after 2 4 --iterations 1 --output own.json")  # fmt: skip
    text = capsys.readouterr().out
    assert "command: python benchmarks/own_starts.py" in text and "hardware: " in text
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("| ")]
    assert len(cells) == 2 + 2 * (1 + 3 * 2)  # the head; skinning, and two methods of two seeds and of both, by split
    assert [line[1] for line in cells[2:]] == ["test"] * 7 + ["flips"] * 7
    document = json.loads((world / "own.json").read_text())
    found = document["measured"]
    assert document["hardware"] and list(found) == ["units", "none", "model", "other", "model, other"]
    skinning, network = found["none"]["test"]["linear blend skinning"], found["model"]["test"]["network"]
    assert skinning["above skinning"]["median"] == skinning["gravity"]["median"] == 0 < skinning["total"]["median"]
    assert (network["windows"], network["lost"], found["model"]["flips"]["network"]["windows"]) == (2, 0, 1)
    low, high = network["after 4"]["quartiles"]
    assert 0 < low <= network["after 4"]["median"] <= high
    assert network["after 2"]["median"] < network["after 4"]["median"] and network["velocity"]["median"] > 0
    assert found["other"] == found["model"]
    both = found["model, other"]["test"]["latents, 1 iteration"]["after 2"]
    single = found["model"]["test"]["latents, 1 iteration"]["after 2"]["median"]
    assert both["mean"] == pytest.approx(single) and both["range"] == [single, single]


def test_windows_are_spread_and_short_takes_are_one(script):
    from helpers.own_windows import spread_windows

    from ssilk_core.quality.evaluation.takes import Take

    def take(frames: int) -> Take:
        motion = type("Motion", (), {"frame_count": frames})
        return Take("", 0, motion)

    found = spread_windows({3: take(40), 4: take(20), 5: take(3)}, 3, (2, 8))
    assert found == [(3, range(7, 17)), (3, range(21, 31)), (4, range(4, 14))]
    assert spread_windows({0: take(7)}, 3, (2, 8)) == [(0, range(7))]
    assert spread_windows({0: take(3)}, 3, (2, 8)) == []


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ("--windows 0", "0 windows"),
        ("--after 0 5", r"after \[0, 5\] frames"),
        ("--splits inertia", "none of the splits inertia is chosen"),
        ("--clips brief --after 8", "flips: its clips are too short"),
        ("--model model.safetensors silk.safetensors", "silk.safetensors: its garment, fabric or rate is not that"),
    ],
)
def test_what_cannot_be_compared_is_refused(script, world, options, complaint):
    file = load_model("model.safetensors")
    save_model("silk.safetensors", replace(file, fabric=replace(file.fabric, bending=2 * file.fabric.bending)))
    with pytest.raises(SsilkError, match=complaint):
        script("own_starts", f"--model model.safetensors {PLACE} --motions clips {options}")


@pytest.mark.slow
def test_a_sheet_has_a_row_for_each_method(script, world):
    """The simulator's positions are written once, and then read: here, moved away by a hand's breadth."""
    options = f"--model model.safetensors {PLACE} --motion clips/brief.usdc --simulation kept.npz"
    script("sheet", options)
    kept = dict(np.load("kept.npz"))
    assert kept["points"].shape == (6, 312, 3) and kept["fps"] == 30
    shown = f"{options} --frames 1 4 5 --size 60 80 --iterations 1 2 -o"
    script("sheet", f"{shown} sheet.png --film film.mp4")
    picture = np.asarray(Image.open("sheet.png")).astype(int)
    assert picture.shape[:2] == (5 * 80 + 4 * GAP, 3 * 60 + 2 * GAP) and Path("film.mp4").stat().st_size > 1000
    np.savez("kept.npz", points=kept["points"] - np.float32([0, 0.01, 0]), fps=kept["fps"])
    script("sheet", f"{shown} moved.png")
    changed = np.abs(np.asarray(Image.open("moved.png")).astype(int) - picture).max(axis=(1, 2)) > 20
    assert changed[:80].any() and not changed[80 + GAP :].any()


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ("", "nothing to write"),
        ("-o sheet.jpg", "sheet.jpg: suffix '.jpg'"),
        ("-o sheet.png --frames 3 6", "there is no frame 6; it has the frames 0 to 5"),
        ("-o sheet.png --simulation kept.txt", "kept.txt: not a name for positions"),
        ("-o sheet.png --simulation other.npz", "other.npz: no positions"),
        ("-o sheet.png --simulation short.npz", r"short.npz: positions of the shape \(5, 312, 3\) at 30 frames"),
    ],
)
def test_a_sheet_that_cannot_be_drawn_is_refused(script, world, options, complaint):
    np.savez("other.npz", x=1)
    np.savez("short.npz", points=np.zeros((5, 312, 3)), fps=30.0)
    with pytest.raises(SsilkError, match=complaint):
        script("sheet", f"--model model.safetensors {PLACE} --motion clips/brief.usdc {options}")
