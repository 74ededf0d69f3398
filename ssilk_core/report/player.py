# SPDX-License-Identifier: Apache-2.0
"""Shots that play in a page: the points of each frame, packed, beside a script that draws them with WebGL 2."""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Sequence
from html import escape
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from ..assets import Floats
from ..errors import fail
from ..events import Progress, Reporter, silent
from ..view.player import ShotPlayer
from ..view.shots import shot_surfaces

FPS = 30.0  # frames per second that a page holds at most; between them, points go straight
MAX_VALUES = 60_000_000  # coordinates that a page holds at most; of longer shots fewer frames
QUANTUM = 1e-4  # [m] to which points are rounded
MOST = 2**15 - 1
APART = 1.6  # between shots that stand side by side [m]
SMOOTH = 1.0  # over which the camera's target is averaged [s]
WORDS = {"play": "Play", "pause": "Pause",
         "hint": "Drag to turn, scroll to come closer; space plays, the arrow keys step."}  # fmt: skip


def script() -> str:
    """Return the script that plays every shot of a page."""
    return files(__package__).joinpath("player.js").read_text(encoding="utf-8")


def played(players: Sequence[ShotPlayer], labels: Sequence[str] = (), report: Reporter = silent) -> str:
    """Return HTML that plays shots of one length and rate, side by side.

    Args:
        labels: a word for each shot.

    Raises:
        SsilkError: shots that do not match, or without frames.
    """
    times = _times(players)
    step = _step(players, len(times))
    frames = range(0, len(times), step)
    shown: list[list[Floats]] = []
    for number, frame in enumerate(frames):
        shown.append([surface.points + [APART * side, 0.0, 0.0] for side, player in enumerate(players)
                      for surface in shot_surfaces(player, frame)])  # fmt: skip
        report(Progress(number + 1, len(frames)))
    surfaces = [surface for player in players for surface in shot_surfaces(player, 0)]
    fps = players[0].fps / step
    origins = np.array([np.nan_to_num(np.concatenate(points)).mean(axis=0) for points in shown])
    meshes, parts, words = [], [], []
    for index, surface in enumerate(surfaces):
        points = np.stack([each[index] for each in shown]) - origins[:, None]
        quantum, values = quantised(np.nan_to_num(points))
        data = surface.faces.astype("<u4").tobytes() + packed(values)
        parts.append(base64.b64encode(zlib.compress(data, 9)).decode())
        meshes.append({"points": points.shape[1], "triangles": len(surface.faces), "step": quantum,
                       "colour": [round(float(part), 4) for part in surface.colour]})  # fmt: skip
        words.append(_word(surface.name, index, players, labels))
    skins = [surface.points for surface in surfaces if not surface.two_sided] or [each.points for each in surfaces]
    about = {
        "fps": fps, "start": times[0], "step": (times[1] - times[0]) * step if len(times) > 1 else 1.0,
        "ground": float(min(np.nan_to_num(points)[:, 1].min() for points in skins)),
        "distance": round(2.2 * float(np.ptp(np.nan_to_num(np.concatenate(shown[0])), axis=0).max()), 3),
        "origins": origins.round(6).tolist(), "centres": _smoothed(origins, fps).round(4).tolist(),
        "meshes": meshes, "words": WORDS,
    }  # fmt: skip
    boxes = "".join(f'<label><input type="checkbox" checked> {escape(word)}</label> ' for word in words)
    data = "".join(f'<script type="text/plain">{part}</script>' for part in parts)
    speeds = "".join(
        f'<option value="{speed:g}"{" selected" if speed == 1 else ""}>{speed:g}×</option>'
        for speed in (0.1, 0.25, 0.5, 1, 2)
    )
    return (
        f'<div class="player" data-about="{escape(json.dumps(about))}"><canvas tabindex="0" role="img" '
        f'aria-label="the shot, playing"></canvas><div class="controls"><button type="button">{WORDS["play"]}</button>'
        f'<input type="range" min="0" value="0" step="any" aria-label="time"><output></output>'
        f'<select aria-label="speed">{speeds}</select></div><div class="controls">{boxes}</div>'
        f'<p class="note">…</p>{data}</div>'
    )


def _times(players: Sequence[ShotPlayer]) -> Sequence[float]:
    """Return the time codes of shots that match."""
    first = players[0]
    if not first.frame_times:
        fail("view", "the shot has no frames", "at least one is needed")
    for other in players[1:]:
        if len(other.frame_times) != len(first.frame_times) or abs(other.fps - first.fps) > 1e-6 * first.fps:
            fail("view", "shots of other lengths or rates", "shots shown together match",
                 "bake them from the same motion")  # fmt: skip
    return first.frame_times


def _step(players: Sequence[ShotPlayer], count: int) -> int:
    """Return how many frames of the shots make one of the page."""
    width = sum(points.size for player in players for points in player.points(player.frame_times[0]))
    rate = int(np.ceil(players[0].fps / FPS - 1e-6))
    return max(rate, int(np.ceil(count * width / MAX_VALUES)), 1)


def _word(name: str, index: int, players: Sequence[ShotPlayer], labels: Sequence[str]) -> str:
    """Return what a mesh is called; with the label of its shot, where there are several."""
    ends = np.cumsum([len(player.meshes) for player in players])
    shot = int(np.searchsorted(ends, index, side="right"))
    return f"{labels[shot]}: {name}" if shot < len(labels) else name


def _smoothed(path: Floats, fps: float) -> Floats:
    """Return a path (F, 3) averaged over `SMOOTH`, its ends repeated."""
    half = max(int(round(SMOOTH * fps / 2)), 1)
    padded = np.pad(path, ((half, half), (0, 0)), mode="edge")
    return np.stack([np.convolve(axis, np.full(2 * half + 1, 1 / (2 * half + 1)), "valid") for axis in padded.T], -1)


def quantised(points: Floats) -> tuple[float, NDArray[np.int16]]:
    """Return points as multiples of a length [m], which is `QUANTUM` unless they reach further than 16 bits count."""
    quantum = max(QUANTUM, float(np.abs(points).max(initial=0.0)) / MOST)
    return quantum, np.round(points / quantum).astype(np.int16)


def packed(values: NDArray[np.int16]) -> bytes:
    """Return values (F, ...) as bytes that compress well: what their speed changes by, low and high bytes apart.

    Differences are modulo 2^16, and zigzag order makes small ones of either sign small.
    """
    flat = values.reshape(len(values), -1).astype(np.int64)
    change = flat.copy()
    change[1:] -= 2 * flat[:-1]
    change[2:] += flat[:-2]
    wrapped = change.astype(np.int16).astype(np.int64)
    zigzag = ((wrapped << 1) ^ (wrapped >> 63)).astype(np.uint16).reshape(-1)
    return (zigzag & 0xFF).astype(np.uint8).tobytes() + (zigzag >> 8).astype(np.uint8).tobytes()
