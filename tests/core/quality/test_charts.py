# SPDX-License-Identifier: Apache-2.0
"""Charts show every value that matters, in colours and markers that differ, and the same data give the same bytes."""

from __future__ import annotations

import warnings
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from ssilk_core.quality.charts import COLOURS, INK, MARKERS, ChartPanel, peaks, svg_chart, write_chart

NAMES = ("one", "two", "_three", "$four$")
CURVES = {name: (np.arange(5.0), np.arange(5.0) + shift) for shift, name in enumerate(NAMES)}


def words(svg: str) -> list[str]:
    return [text.text for text in ElementTree.fromstring(svg).iter("{http://www.w3.org/2000/svg}text")]


def test_no_peak_is_lost_to_thinning():
    values = np.sin(np.arange(100_000) / 500)
    values[77_777], values[33_333] = 9, -9
    shown = peaks(values)
    assert {0, 33_333, 77_777, 99_999} <= set(shown) and len(shown) <= 1202 and shown == sorted(shown)
    assert peaks(np.zeros(1)) == [0]


def test_the_same_data_give_the_same_bytes(tmp_path):
    rows = [[ChartPanel(title="t", x="time [s]", y="J", curves=CURVES, marks={"A": (1.0, 2.0)}, levels=(0.5,))]]
    for name in "ab":
        write_chart(tmp_path / f"{name}.png", rows)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert svg_chart("label", rows) == svg_chart("label", rows)
    assert b"Software" not in (tmp_path / "a.png").read_bytes()


def test_words_are_text_as_it_was_given_and_take_the_colour_of_the_page():
    svg = svg_chart("what it shows", [[ChartPanel(title="a < b", x="time [s]", y="J", curves=CURVES)]])
    assert {"a < b", "time [s]", "J", *NAMES} <= set(words(svg))
    assert 'aria-label="what it shows"' in svg and INK not in svg and "currentColor" in svg
    assert "date" not in svg.lower() and " id=" not in svg.partition("</defs>")[2].partition("<g>")[0]


def test_each_name_has_a_colour_and_a_marker_of_its_own(tmp_path):
    assert len(set(COLOURS)) == len(set(MARKERS)) == len(COLOURS) == len(MARKERS)
    points = {name: [(1.0 + n, 1.0 + n, "")] for n, name in enumerate(NAMES)}
    write_chart(tmp_path / "c.png", [[ChartPanel(x="ms", y="mm", points=points)]])
    seen = {colour[:3] for _, colour in Image.open(tmp_path / "c.png").convert("RGB").getcolors(1 << 20)}
    asked = {tuple(bytes.fromhex(colour[1:])) for colour in COLOURS[: len(NAMES)]}
    assert asked <= seen


@pytest.mark.parametrize("values", [[0.0], [1.0, 2, 3], [-5.0, -1], [0.0, 0, 0], [1.0, np.nan, 2]])
def test_any_values_are_drawn_without_a_warning(values):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        svg_chart("any", [[ChartPanel(x="s", y="J", curves={"": (np.arange(len(values)), np.array(values))})]])


def test_logarithmic_axes_keep_zero_and_label_plain_numbers():
    points = {"a": [(0.1, 0.0, "nothing"), (10.0, 100.0, "much")]}
    found = words(
        svg_chart("log", [[ChartPanel(x="ms", y="mm", points=points, log_x=True, linear_below=0.1)]], size=(6, 4))
    )
    assert {"0.1", "1", "10", "0", "100", "nothing", "much"} <= set(found)


@pytest.mark.parametrize("highest, ticks", [(50.0, {"0.2", "0.5", "20"}), (5e4, {"100", "1000", "10000"})])
def test_a_logarithmic_axis_has_only_as_many_labels_as_find_room(highest, ticks):
    points = {"a": [(0.1, 1.0, ""), (highest, 2.0, "")]}
    found = set(words(svg_chart("log", [[ChartPanel(x="ms", y="mm", points=points, log_x=True)]], size=(6, 4))))
    assert ticks <= found and ({"0.2", "20", "200"} & found != set()) == (highest == 50)


def test_words_of_points_do_not_cover_each_other():
    crowd = {"a": [(1.0, 1.0, f"a long name {number}") for number in range(9)]}
    found = words(svg_chart("crowd", [[ChartPanel(x="ms", y="mm", points=crowd)]], size=(4, 3)))
    assert 1 <= sum(word.startswith("a long name") for word in found) <= 4
