# SPDX-License-Identifier: Apache-2.0
"""Shots that play in a page: what is packed comes back, and the page runs the player's script alone."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
import zlib
from dataclasses import dataclass

import numpy as np
import pytest

from ssilk_core.delivery.report.page import Section, page, script
from ssilk_core.delivery.report.player import QUANTUM, packed, played, quantised
from ssilk_core.errors import SsilkError

FACES = np.array([[0, 1, 2], [0, 2, 3]])


@dataclass(frozen=True)
class Cloth:
    name: str
    is_garment: bool
    faces = FACES
    colour = None
    is_rider = False


class Waving:
    """A quad that waves while it flies, above one that is not finite at times."""

    meshes = (Cloth("<Cape>", True), Cloth("Body", False))

    def __init__(self, frames: int = 9, fps: float = 30.0) -> None:
        self.fps, self.frame_times = fps, tuple(100.0 + np.arange(frames))

    def points(self, time: float) -> list[np.ndarray]:
        quad = np.array([[0, 1, 0], [1, 1, 0], [1, 2, 0], [0, 2, 0]], dtype=float)
        wave = 0.3 * np.sin(0.9 * time + quad[:, :1]) * [0, 0, 1]
        body = quad - [0, 1, 0]
        return [quad + wave + [1000 + 3 * time, 0, 0], np.where(time == 104, np.nan, body) + [1000 + 3 * time, 0, 0]]


def unpacked(data: bytes, frames: int) -> np.ndarray:
    """What the script does: join the bytes, undo zigzag, then sum twice modulo 2^16."""
    low, high = np.frombuffer(data, np.uint8).reshape(2, frames, -1).astype(np.int64)
    word = low | (high << 8)
    change = (word >> 1) ^ -(word & 1)
    return np.cumsum(np.cumsum(change, axis=0), axis=0).astype(np.int16)


def test_what_is_packed_comes_back_also_where_differences_overflow():
    values = np.random.default_rng(0).integers(-(2**15), 2**15, (7, 5), dtype=np.int16)
    np.testing.assert_array_equal(unpacked(packed(values), 7), values)


def test_points_are_multiples_of_a_tenth_of_a_millimetre_unless_they_reach_too_far():
    assert quantised(np.array([0.00014, -3.0]))[1].tolist() == [1, -30000]
    step, values = quantised(np.array([100.0, -50.0]))
    assert step > QUANTUM and np.abs(values * step - [100, -50]).max() < step


def test_a_page_holds_each_frame_of_each_mesh():
    shot = Waving()
    text = played([shot])
    about = json.loads(html.unescape(re.search(r'data-about="([^"]*)"', text)[1]))
    parts = re.findall(r'<script type="text/plain">([A-Za-z0-9+/=]*)</script>', text)
    assert len(parts) == 2 and about["start"] == 100 and about["step"] == 1 and about["fps"] == 30
    assert "&lt;Cape&gt;" in text and "<Cape>" not in text
    for index, (part, mesh) in enumerate(zip(parts, about["meshes"])):
        data, cut = zlib.decompress(base64.b64decode(part)), 4 * 3 * mesh["triangles"]
        np.testing.assert_array_equal(np.frombuffer(data[:cut], "<u4").reshape(-1, 3), FACES)
        found = unpacked(data[cut:], 9).reshape(9, 4, 3) * mesh["step"] + np.array(about["origins"])[:, None]
        expected = np.stack([shot.points(time)[index] for time in shot.frame_times])
        finite = np.isfinite(expected)
        assert np.abs(found - np.nan_to_num(expected))[finite].max() < 0.6 * QUANTUM
    assert finite.sum() < finite.size


def test_long_and_fast_shots_have_fewer_frames(monkeypatch):
    def frames(shot: Waving) -> tuple[int, float, float]:
        about = json.loads(html.unescape(re.search(r'data-about="([^"]*)"', played([shot]))[1]))
        return len(about["origins"]), about["fps"], about["step"]

    assert frames(Waving(9, 120.0)) == (3, 30.0, 4.0)
    monkeypatch.setattr("ssilk_core.delivery.report.player.MAX_VALUES", 9 * 24 // 3)
    assert frames(Waving()) == (3, 10.0, 3.0)


def test_shots_side_by_side_have_labels_and_must_match():
    assert "checked> mine: Body<" in played([Waving(), Waving()], ["mine", "theirs"])
    with pytest.raises(SsilkError, match="same length and rate"):
        played([Waving(), Waving(8)])


def test_a_page_runs_the_players_script_alone_and_fetches_nothing():
    text = page("<b>", [Section("The shot", played([Waving()]), plays=True)])
    code = re.search(r"<script>(.*)</script>", text, re.DOTALL)[1]
    assert code == script()
    digest = base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', text)
    assert policy.startswith("default-src 'none';") and policy.endswith(f"; script-src 'sha256-{digest}'")
    assert not re.search(r"https?:|fetch\(|import|XMLHttp|src=", code) and "</script" not in code
    assert "script-src" not in page("<b>", [Section("Words", "none")])
