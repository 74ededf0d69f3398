# SPDX-License-Identifier: Apache-2.0
"""Curves in time with continuous acceleration, and the rotations they drive."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from ..scene.assets import Floats

FPS = 30.0


def clock(seconds: float) -> Floats:
    """Return frame times [s] from 0."""
    return np.arange(round(seconds * FPS) + 1) / FPS


def ease(x: ArrayLike) -> Floats:
    """Return the quintic step from 0 (x <= 0) to 1 (x >= 1): velocity and acceleration vanish at both ends."""
    inside: Floats = np.clip(np.asarray(x, dtype=np.float64), 0.0, 1.0)
    return inside**3 * (10.0 - 15.0 * inside + 6.0 * inside**2)


def ramp(x: ArrayLike) -> Floats:
    """Return the integral of `ease`: at rest for x <= 0, of unit speed (x - 1/2) for x >= 1."""
    x = np.asarray(x, dtype=np.float64)
    inside = np.clip(x, 0.0, 1.0)
    return inside**4 * (2.5 - 3 * inside + inside**2) + np.maximum(x - 1, 0.0)


def travel(x: ArrayLike, total: float, soft: float) -> Floats:
    """Return the way gone by x, 0 to `total - soft`: starts and stops within `soft`, of unit speed between."""
    x = np.asarray(x, dtype=np.float64)
    return soft * (ramp(x / soft) - ramp((x - total) / soft + 1))


def keyframes(time: Floats, *keys: tuple[float, ArrayLike]) -> Floats:
    """Return a curve through (time, value) keys, at rest at each: so give the extremes of a movement alone."""
    value = np.broadcast_to(np.asarray(keys[0][1], dtype=np.float64), (*time.shape, *np.shape(keys[0][1])))
    for (start, low), (stop, high) in pairwise(keys):
        step = ease((time - start) / (stop - start)).reshape(time.shape + (1,) * np.ndim(low))
        value = value + step * (np.asarray(high) - np.asarray(low))
    return value


def bump(x: ArrayLike) -> Floats:
    """Return a smooth hill, 0 outside (0, 1) and 1 at 1/2."""
    inside: Floats = np.clip(np.asarray(x, dtype=np.float64), 0.0, 1.0)
    return 64.0 * (inside * (1.0 - inside)) ** 3


def about(axis: int, angle: ArrayLike) -> Floats:
    """Return rotations (..., 3, 3) by angles [rad] about x (0), y (1) or z (2)."""
    angle = np.asarray(angle, dtype=np.float64)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    result = np.zeros((*angle.shape, 3, 3))
    result[..., axis, axis] = 1
    result[..., i, i] = result[..., j, j] = np.cos(angle)
    result[..., j, i] = np.sin(angle)
    result[..., i, j] = -np.sin(angle)
    return result


def euler_rotations(angles: Floats) -> Floats:
    """Return rotations (..., 3, 3) of (pitch forward, yaw to the left, roll to the left) [rad]; yaw acts last."""
    pitch, yaw, roll = np.moveaxis(angles, -1, 0)
    return about(1, yaw) @ about(0, pitch) @ about(2, -roll)


def apply(rotations: Floats, vectors: ArrayLike) -> Floats:
    """Return rotated vectors (..., 3)."""
    return (rotations @ np.asarray(vectors, dtype=np.float64)[..., None])[..., 0]
