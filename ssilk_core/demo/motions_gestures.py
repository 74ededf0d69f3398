# SPDX-License-Identifier: Apache-2.0
"""What is done on the spot, both feet on the ground: standing still, and gestures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..scene.assets import Floats
from .motions_biped import Biped, Track
from .motions_curves import clock, ease, euler_rotations, keyframes


def idle(biped: Biped, seconds: float) -> Track:
    """Return standing still: breath, and weight that shifts a little from foot to foot."""
    time = clock(seconds)
    still = biped.stand(len(time))
    there = ease(time / 0.8) * ease((seconds - time) / 0.8)
    shift, breath = there * np.sin(2 * np.pi * time / 3.3), there * np.sin(2 * np.pi * time / 2.6)
    zero = np.zeros_like(time)
    hips = still.hips + 0.012 * biped.scale * np.stack([shift, -0.15 * abs(there), zero], axis=-1)
    spine = np.stack([0.02 * breath, 0.02 * shift, 0.02 * shift], axis=-1)
    return replace(still, hips=hips, spine=spine, head=np.stack([-0.02 * breath, 0.12 * shift, zero], axis=-1))


def gesture(
    biped: Biped,
    seconds: float,
    *,
    hips: tuple = (),
    pelvis: tuple = (),
    spine: tuple = (),
    head: tuple = (),
    left: tuple = (),
    right: tuple = (),
) -> Track:
    """Return a gesture with both feet on the ground, from (time, value) keys at the extremes of each part.

    Values are added to the stand: `hips` (x, y, z) [m]; `pelvis`, `spine`, `head` (pitch, yaw, roll) and the arms
    `left`, `right` (swing, lift, twist, bend) in degrees. Before the first key and after the last it stands.
    """
    time = clock(seconds)
    still = biped.stand(len(time))
    rest = (0.35, seconds - 0.4)
    arms = np.stack([degrees(time, rest, left, 4), degrees(time, rest, right, 4)], axis=1)
    return replace(
        still,
        hips=still.hips + biped.scale * between(time, rest, hips, 3),
        pelvis=euler_rotations(degrees(time, rest, pelvis, 3)),
        spine=degrees(time, rest, spine, 3),
        head=degrees(time, rest, head, 3),
        arms=still.arms + arms,
    )


def between(time: Floats, rest: tuple[float, float], keys: tuple, size: int) -> Floats:
    """Return a curve through `keys` that is zero outside `rest`, shape (F, size)."""
    zero = np.zeros(size)
    return keyframes(time, (rest[0], zero), *keys, (rest[1], zero))


def degrees(time: Floats, rest: tuple[float, float], keys: tuple, size: int) -> Floats:
    """Return `between` of keys in degrees as radians."""
    return np.radians(between(time, rest, keys, size))
