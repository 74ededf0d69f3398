# SPDX-License-Identifier: Apache-2.0
"""Shots that play in a page: the points of each frame, packed, beside a script that draws them with WebGL 2."""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Iterator, Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from ...events import Countdown, Reporter, silent
from ...scene.assets import Floats, Ints
from ..view.colours import PROP
from ..view.player import PlayerMesh, ShotPlayer
from ..view.props import FigureBox, ShotProps
from ..view.shots import mesh_colours, need_matching
from .props import PlayedProp, played_props

FPS = 30.0  # frames per second that a page holds at most; between them, points go straight
MAX_VALUES = 30_000_000  # coordinates that a page holds at most; of longer shots fewer frames
QUANTUM = 1e-4  # [m] to which points are rounded
MOST = 2**15 - 1
APART = 1.6  # between shots that stand side by side [m]
SMOOTH = 1.0  # over which the camera's target is averaged [s]
WORDS = {"play": "Play", "pause": "Pause", "frame": "Frame",
         "hint": "Drag to turn, scroll to come closer; space plays, the arrow keys step."}  # fmt: skip


def played(
    players: Sequence[ShotPlayer],
    labels: Sequence[str] = (),
    report: Reporter = silent,
    props: Sequence[ShotProps | None] = (),
) -> str:
    """Return HTML that plays shots of one length and rate, side by side.

    Args:
        labels: a word for each shot.
        props: of each shot, where its cloth met any.

    Raises:
        SsilkError: shots that do not match, or without frames.
    """
    need_matching(players)
    times = players[0].frame_times
    step = _step(players)
    frames, fps = range(0, len(times), step), players[0].fps / step
    origins, shown = zip(*_posed(players, frames, report))
    path = np.array(origins)
    described = list(_described(players, labels))
    skins = [index for index, (_, mesh, _) in enumerate(described) if not (mesh.is_garment or mesh.is_rider)]
    lows = [float((own[index][:, 1] + origin[1]).min()) for own, origin in zip(shown, path) for index in skins]
    lowest = min(lows, default=float(np.concatenate(shown[0])[:, 1].min() + path[0, 1]))
    boxes = [[FigureBox.of(np.concatenate(each) + origin) for each, origin in zip(own, path)]
             for own in _of_players(players, shown)]  # fmt: skip
    size = float(np.median([box.size for own in boxes for box in own]))
    floors = (met.ground(lowest, size) for met in props if met)
    ground = next((floor for floor in floors if floor is not None), lowest)
    parts, meshes, words = [], [], []
    for index, (word, mesh, colour) in enumerate(described):
        quantum, values = quantised(np.stack([each[index] for each in shown]))
        parts.append(_stored(mesh.faces, values))
        meshes.append(_about_mesh(values, mesh.faces, quantum, colour))
        words.append(word)
    for side, (met, label) in enumerate(zip(props, (*labels, *[""] * len(props)))):
        for prop in played_props(met, frames, boxes[side], ground, APART * side, report) if met else ():
            place, quantum, values = _prop_values(prop, path)
            parts.append(_stored(prop.faces, values))
            meshes.append({**_about_mesh(values, prop.faces, quantum, PROP), **place})
            words.append(f"{label}: {prop.name}" if label else prop.name)
    about = {
        "fps": fps, "start": times[0], "step": (times[1] - times[0]) * step if len(times) > 1 else 1.0,
        "ground": ground,
        "distance": round(2.1 * float(np.ptp(np.concatenate(shown[0]), axis=0).max()), 3),
        "origins": path.round(6).tolist(), "centres": _smoothed(path, fps).round(4).tolist(),
        "meshes": meshes, "words": WORDS,
    }  # fmt: skip
    ticks = "".join(f'<label><input type="checkbox" checked> {escape(word)}</label> ' for word in words)
    texts = "".join(f'<script type="text/plain">{part}</script>' for part in parts)
    speeds = "".join(
        f'<option value="{speed:g}"{" selected" if speed == 1 else ""}>{speed:g}×</option>'
        for speed in (0.1, 0.25, 0.5, 1, 2)
    )
    return (
        f'<div class="player" data-about="{escape(json.dumps(about))}"><canvas tabindex="0" role="img" '
        f'aria-label="the shot, playing"></canvas>'
        f'<div class="controls"><button type="button">{WORDS["play"]}</button>'
        f'<input type="range" min="0" value="0" step="any" aria-label="time"><output></output>'
        f'<select aria-label="speed">{speeds}</select></div><div class="controls">{ticks}</div>'
        f'<p class="note">…</p>{texts}</div>'
    )


def _of_players(players: Sequence[ShotPlayer], shown: Sequence[Sequence[Floats]]) -> list[list[list[Floats]]]:
    """Return the meshes of each shot alone, in each frame."""
    ends = np.cumsum([len(player.meshes) for player in players]).tolist()
    spans = [slice(end - len(player.meshes), end) for player, end in zip(players, ends)]
    return [[list(each[span]) for each in shown] for span in spans]


def _stored(faces: Ints, values: NDArray[np.int16]) -> str:
    """Return triangles (T, 3) and points (F, P, 3) as text."""
    data = np.asarray(faces).astype("<u4").tobytes() + packed(values)
    return base64.b64encode(zlib.compress(data, 9)).decode()


def _about_mesh(values: NDArray[np.int16], faces: Ints, quantum: float, colour: NDArray) -> dict[str, object]:
    return {"points": values.shape[1], "triangles": len(faces), "step": quantum,
            "colour": np.asarray(colour).round(4).tolist()}  # fmt: skip


def _prop_values(prop: PlayedProp, path: Floats) -> tuple[dict[str, object], float, NDArray[np.int16]]:
    """Return what a page says of the place of a prop, and its points from there; one that stays has one frame."""
    if len(prop.points) > 1:
        quantum, values = quantised(prop.points - path[:, None])
        return {}, quantum, values
    place = prop.points[0].mean(axis=0).round(6)
    quantum, values = quantised(prop.points - place)
    return {"place": place.tolist()}, quantum, values


def _step(players: Sequence[ShotPlayer]) -> int:
    """Return how many frames of the shots make one of the page."""
    width = sum(points.size for player in players for points in player.points(player.frame_times[0]))
    count, rate = len(players[0].frame_times), int(np.ceil(players[0].fps / FPS - 1e-6))
    return max(rate, int(np.ceil(count * width / MAX_VALUES)), 1)


def _posed(
    players: Sequence[ShotPlayer], frames: Sequence[int], report: Reporter
) -> Iterator[tuple[Floats, list[NDArray[np.float32]]]]:
    """Yield where the middle of all points is at each frame, shape (3,), and the points of all meshes from there.

    What is not finite stands in the middle.
    """
    told = Countdown(len(frames), report)
    for frame in frames:
        meshes = [points + [APART * side, 0.0, 0.0] for side, player in enumerate(players)
                  for points in player.points(player.frame_times[frame])]  # fmt: skip
        every = np.concatenate(meshes)
        finite = every[np.isfinite(every).all(axis=1)]
        middle = finite.mean(axis=0) if len(finite) else np.zeros(3)
        away = [(points - middle).astype(np.float32) for points in meshes]
        yield middle, [np.nan_to_num(points, nan=0, posinf=0, neginf=0) for points in away]
        told()


def _described(
    players: Sequence[ShotPlayer], labels: Sequence[str]
) -> Iterator[tuple[str, PlayerMesh, NDArray[np.floating]]]:
    """Yield what each mesh is called, after the label of its shot; the mesh; and its colour."""
    for player, label in zip(players, (*labels, *[""] * len(players))):
        for mesh, colour in zip(player.meshes, mesh_colours(player)):
            yield f"{label}: {mesh.name}" if label else mesh.name, mesh, np.asarray(colour)


def _smoothed(path: Floats, fps: float) -> Floats:
    """Return a path (F, 3) averaged over `SMOOTH`, its ends repeated."""
    half = max(round(SMOOTH * fps / 2), 1)
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
