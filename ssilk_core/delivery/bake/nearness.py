# SPDX-License-Identifier: Apache-2.0
"""Whether given points are of the garment where its character wears it, before joints and blendshapes are fitted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import permutations, product

import numpy as np

from ...errors import fail
from ...events import Message, Reporter, silent
from ...scene.assets import Deformer, Floats, Motion
from ...scene.kinematics import deform, lbs_deformer, lbs_poses
from ...scene.mesh.topology import edges

FRAMES = 9  # that are looked at, evenly; cloth is near its body in one of them at least
SCALES = 0.6, 1.6  # of the median edge against the garment's at rest, beyond which units are wrong
FAR, TOLD = 0.5, 0.25  # RMS distance as a share of the garment's size that is refused, or told
CLEAR = 3.0  # how many times nearer points are once they are turned or mirrored, where that is what is wrong
NEAR = 0.05  # share of the garment's size within which nothing is asked


def need_near(
    deformer: Deformer, motion: Motion, points: Sequence[Floats], where: str, report: Reporter = silent
) -> None:
    """Compare points with the garment as linear blend skinning moves it, in the frames where they are nearest.

    Args:
        deformer: the garment on its character.
        motion: of the character, at the frames of `points`.
        points: garment vertices of each frame in world space [m], shape (V, 3).
        where: what the points come from, for messages.
        report: hears of points that are rather far off.

    Raises:
        SsilkError: the points are of another size, turned, mirrored, or far from the garment in every frame.
    """
    mesh = deformer.scene.garment.mesh
    pairs, size = edges(mesh.faces), float(np.linalg.norm(np.ptp(mesh.points, axis=0)))
    frames = sorted(set(np.linspace(0, len(points) - 1, min(len(points), FRAMES)).round().astype(int).tolist()))
    worn = lbs_deformer(deformer.scene)
    skinned = [deform(worn, motion.clip(frame, frame + 1), next(lbs_poses(1)))[0] for frame in frames]
    given = [points[frame] for frame in frames]
    if any(each.shape != mesh.points.shape or not np.isfinite(each).all() for each in given):
        return  # whoever fits them says so
    scale = min((_edge(each, pairs) / _edge(own, pairs) for each, own in zip(given, skinned)), key=_off)
    if not SCALES[0] < scale < SCALES[1]:
        fail(
            where,
            f"its edges are {scale:.3g} times as long as the garment's",
            "the points are those of the garment in metersPerUnit of their file, centimetres where it says nothing",
            "set metersPerUnit of that file to the units of its points",
        )
    away = min(_rms(each - own) for each, own in zip(given, skinned))
    if away <= NEAR * size:
        return
    turned = [(min(_rms(each @ turn.T - own) for each, own in zip(given, skinned)), says) for turn, says in _turns()]
    nearest, says = min(turned)
    if CLEAR * nearest < away:
        fail(
            where,
            f"its points are {1000 * away:.0f} mm RMS off the skinned garment, and fit it where {says}",
            "points and character share their axes",
            "set upAxis of that file to the axis of its points, or export them again",
        )
    text = f"its points are {1000 * away:.0f} mm RMS off the skinned garment in the nearest of {len(frames)} frames"
    if away > FAR * size:
        fail(
            where,
            text,
            f"cloth on its character is within half its size, {500 * size:.0f} mm, once",
            "check the character's motion and place, and units, axis and time of the points",
        )
    if away > TOLD * size:
        report(Message(f"{where}: {text}; are motion, place, units, axis and time those of the points?", "warning"))


def _edge(points: Floats, pairs: np.ndarray) -> float:
    return float(np.median(np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)))


def _off(scale: float) -> float:
    return abs(float(np.log(max(scale, 1e-12))))


def _rms(offsets: Floats) -> float:
    return float(np.sqrt((offsets**2).sum(axis=1).mean()))


def _turns() -> Iterator[tuple[Floats, str]]:
    """Yield all ways to exchange and reverse axes but the identity, each with its words."""
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        turn = np.diag(signs) @ np.eye(3)[list(order)]
        if order != (0, 1, 2) or min(signs) < 0:
            axes = ", ".join(f"{'-' if sign < 0 else ''}{'xyz'[axis]}" for axis, sign in zip(order, signs))
            yield turn, f"(x, y, z) become ({axes}){', mirrored' if np.linalg.det(turn) < 0 else ''}"
