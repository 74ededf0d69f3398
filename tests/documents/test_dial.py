# SPDX-License-Identifier: Apache-2.0
"""The dial's table and picture show what its result files hold."""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import pytest
from PIL import Image

from ssilk_core.errors import SsilkError

ROOT = Path(__file__).parents[2]
PLACES = ("network", "hero", "simulator", "simulator, 1 mm off")
FIGURES = ("velocity", "total", "shown", "limbs", "intersecting", "jitter")


def record(place: str, split: str) -> dict[str, object]:
    """A row of three windows, whose median is 10 times the place's number, and 100 times that on flips."""
    size = PLACES.index(place) * (100.0 if split == "flips" else 1.0)
    values = [0.01 * size, 0.02 * size, 0.06 * size]
    figures = dict.fromkeys(FIGURES, values)
    return {"split": split, "place": place, "lost": 0, "distance": {"10": values, "30": values}} | figures


@pytest.fixture
def folder(monkeypatch, tmp_path):
    """Result files of all garments that the tables read in place of the project's own."""
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    from documents import forms

    forms.document.cache_clear()
    monkeypatch.setattr(sys.modules["documents.forms"], "RESULTS", tmp_path)
    shutil.copy(ROOT / "benchmarks" / "results" / "trade_cuda.json", tmp_path)
    for garment in forms.GARMENTS:
        times = [
            {"place": place, "device": device, "milliseconds": 10.0**at * scale}
            for at, place in enumerate(PLACES[:3])
            for device, scale in (("cpu", 1.0), ("cuda", 0.5))
        ]
        rows = [record(place, split) for split in ("test", "flips") for place in PLACES]
        (tmp_path / f"dial_{garment}.json").write_text(json.dumps({"times": times, "figures": rows}))
    yield tmp_path
    forms.document.cache_clear()


def test_a_place_has_a_row_with_both_splits(folder):
    from documents.dial import dial

    header, _, *lines = ([cell.strip() for cell in line.split("|")[1:-1]] for line in dial().splitlines())
    assert {len(line) for line in lines} == {len(header)} and len(lines) == 3 * len(PLACES)
    assert [line[0] for line in lines if line[0]] == ["cape", "fringe skirt", "hooded dress"]
    own = dict(zip(header, lines[1]))
    assert own["place"] == "`hero`" and (own["one core [ms]"], own["GPU [ms]"]) == ("10", "5.0")
    assert own["after 10 [mm]"] == own["30 [mm]"] == "20, 2,000"  # of three windows the one in the middle
    assert own["energy [J]"] == "0.0300, 3.00" and own["shows [%]"] == "3.00, 300.00"  # their mean
    assert [line[-2:] for line in lines[:4]] == [["6.3", "4.9"], ["6.3", "1.0"], ["", "1.0"], ["", ""]]  # of the cape
    assert lines[3][2:4] == ["", ""]  # not timed


def test_the_picture_needs_times_of_each_garment(folder, tmp_path):
    from documents.dial import draw, panel

    drawn = panel("cape", "cpu")
    assert drawn.points["test"] == [(1, 0, ""), (10, 20, ""), (100, 40, "")] and drawn.levels == (60, 6000)
    assert [name for _, _, name in drawn.points["flips"]] == list(PLACES[:3])
    draw(tmp_path / "dial.png")
    width, height = Image.open(tmp_path / "dial.png").size
    assert width > height > 200
    path = folder / "dial_fringe_skirt.json"
    document = json.loads(path.read_text())
    document["times"] = [time for time in document["times"] if time["device"] != "cpu"]
    path.write_text(json.dumps(document))
    sys.modules["documents.forms"].document.cache_clear()
    with pytest.raises(SsilkError, match=r"dial_fringe_skirt.json: no times of one core"):
        draw(tmp_path / "other.png")
    assert not (tmp_path / "other.png").exists()
