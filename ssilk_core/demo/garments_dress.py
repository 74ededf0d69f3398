# SPDX-License-Identifier: Apache-2.0
"""A sleeveless dress to the ankles with a hood: one closed surface from crown to hem, with three holes cut in it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ..scene.assets import Floats, Ints
from .garments_fit import BodyFit, keep_off, outline, relax, through
from .garments_mesh import cap, cut, length, loft

CLEARANCE = 0.013  # [m]
EDGE = 0.023  # [m]


def hooded_dress(fit: BodyFit) -> tuple[Floats, Ints]:
    """Cut the dress: hood round the head, bodice close to the chest, skirt flared to the ankles."""
    s = fit.size
    trunk = without_arms(fit, s)
    grid, _ = through(dress_keys(trunk, s), 140)
    bare, chest = fit.joint("Neck")[1] + 0.005 * s, fit.joint("Hips")[1] + 0.06 * s
    height = grid[:, :, 1].mean(axis=1)
    close = (height < bare) & (height > chest)
    grid = relax(trunk, grid, CLEARANCE, cling=np.where(close, 0.25, 0.0)[:, None], rounds=40, closed=True)
    points, faces = loft(grid, EDGE * s, closed=True)
    points, faces = cap(points, faces, max(3, round(length(grid[0]) / (EDGE * s))))
    shoulder, elbow = fit.joint("LeftArm"), fit.joint("LeftForeArm")
    points, faces = cut(points, faces, lambda p: face_opening(fit, s, p), EDGE * s)
    for side in (1.0, -1.0):
        points, faces = cut(points, faces, armhole(shoulder, elbow, s, side), EDGE * s)
    for _ in range(3):
        points = keep_off(fit, points, CLEARANCE)
    return points, faces


def without_arms(fit: BodyFit, s: float) -> BodyFit:
    """Return the body less its arms, from a little inside the shoulder joints."""
    beyond = np.abs(fit.points[:, 0]) > fit.joint("LeftArm")[0] + 0.03 * s
    arms = beyond & (fit.points[:, 1] > fit.joint("LeftLeg")[1] + 0.2 * s)
    return replace(fit, faces=fit.faces[~arms[fit.faces].any(axis=1)])


def dress_keys(trunk: BodyFit, s: float) -> Floats:
    """Return closed lines round the body that shape the dress, from crown to hem, shape (K, 97, 3)."""
    head, neck, shoulder, hips = (trunk.joint(name) for name in ("Head", "Neck", "LeftArm", "Hips"))
    crown = trunk.points[:, 1].max()
    angle = np.linspace(0, 2 * np.pi, 97)
    sides = np.sin(angle) ** 2

    def ring(height: float, clearance: float, drop: float = 0.0, *, wide: float = 1.0, half: float = 0.2) -> Floats:
        line = outline(trunk, height, clearance * s, half_width=half * s)
        centre = line[:-1].mean(axis=0)
        line = centre + (line - centre) * (wide, 1.0, 1.0)
        line[:, 1] -= drop * s * (1 - sides)
        return line

    skull = ring(crown - 0.10 * s, 0.03)
    middle = skull[:-1].mean(axis=0)
    dome = [middle + (skull - middle) * f + (0, h * s, 0) for f, h in ((0.12, 0.122), (0.55, 0.106), (0.88, 0.06))]
    nape = ring(neck[1] + 0.025 * s, 0.035)
    base = np.array([0.0, neck[1] - 0.02 * s, neck[2] - 0.01 * s])
    yoke = base + np.stack([0.115 * np.sin(angle), -0.035 * (1 - sides), -0.105 * np.cos(angle)], axis=1) * s
    tip = np.array([0.0, shoulder[1] + 0.03 * s, shoulder[2] - 0.01 * s])
    tip = tip + np.stack([0.185 * np.sin(angle), -0.075 * (1 - sides), -0.125 * np.cos(angle)], axis=1) * s
    ankle = trunk.joint("LeftFoot")
    hem = np.array([0.0, ankle[1] + 0.035 * s, hips[2]])
    hem = hem + np.stack([0.46 * np.sin(angle), 0 * angle, -0.44 * np.cos(angle)], axis=1) * s
    hip = ring(hips[1] - 0.03 * s, 0.03, half=0.27)
    return np.stack(
        [
            *dome,
            skull,
            ring(head[1] + 0.03 * s, 0.035),
            nape,
            yoke,
            tip,
            ring(shoulder[1] - 0.13 * s, 0.015, half=0.19),
            ring(hips[1] + 0.16 * s, 0.018, half=0.27),
            hip,
            hem,
        ]
    )


def face_opening(fit: BodyFit, s: float, points: Floats) -> Floats:
    """Return how far points lie inside the opening for the face [m], positive inside, shape (N,)."""
    chin = fit.joint("Head")
    crown = fit.points[:, 1].max()
    middle = np.array([0.0, (chin[1] + crown) / 2 - 0.03 * s])
    size = np.array([0.085 * s, (crown - chin[1]) / 2 + 0.035 * s])
    inside = (1 - np.linalg.norm((points[:, :2] - middle) / size, axis=1)) * size[0]
    return np.where(points[:, 2] > chin[2], inside, -1.0)


def armhole(shoulder: Floats, elbow: Floats, s: float, side: float) -> Callable[[Floats], Floats]:
    """Return how far points lie inside the left (`side` 1) or the right (-1) armhole [m], as a function of them."""
    arm = (elbow - shoulder) / np.linalg.norm(elbow - shoulder)
    axis = (arm + (1, 0, 0)) / np.linalg.norm(arm + (1, 0, 0))
    start = shoulder - (0, 0.015 * s, 0)

    def inside(points: Floats) -> Floats:
        offset = points * (side, 1, 1) - start
        across = offset - (offset @ axis)[:, None] * axis
        return np.where(offset @ axis > -0.06 * s, 0.076 * s - np.linalg.norm(across, axis=1), -1.0)

    return inside
