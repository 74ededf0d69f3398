# SPDX-License-Identifier: Apache-2.0
"""Uniform scales of joints, taken out of their transforms.

Rigs scale joints once and for all: by -1 where one side is the mirror image of the other, by 3 where an eye was
modelled in other units. Skinning by joint transforms P and bind transforms B has P B^-1, which stays the same where
both are divided by one factor from the right. So a factor that is the same in the bind pose and in all frames moves
no point, and joints without it are rigid: the core knows no others.
"""

from __future__ import annotations

import numpy as np

from ssilk_core.scene.assets import Floats, Ints

SCALE_TOLERANCE = 1e-3  # relative; animations hold scales in half precision


def uniform_scales(local: Floats) -> Floats:
    """Return the factor of each joint-to-parent transform (..., 4, 4), negative where it mirrors, shape (...).

    NaN where it is not one factor in all directions. What is within the tolerance of 1 is 1, so that rounding does
    not add up along chains of joints.
    """
    linear = local[..., :3, :3]
    factors = np.cbrt(np.linalg.det(linear))
    off = np.abs(linear @ np.swapaxes(linear, -1, -2) - np.square(factors)[..., None, None] * np.eye(3))
    factors = np.where(np.abs(factors - 1) <= SCALE_TOLERANCE, 1.0, factors)
    return np.where(off.max(axis=(-1, -2)) <= 2 * SCALE_TOLERANCE * np.square(factors), factors, np.nan)


def total_scales(factors: Floats, parents: Ints) -> Floats:
    """Return the factor of each joint's space, with those of the joints above it, in any order, shape (N,)."""
    totals = []
    for joint in range(len(factors)):
        total, above = 1.0, joint
        while above >= 0:
            total, above = total * float(factors[above]), int(parents[above])
        totals.append(total)
    return np.array(totals)


def without_scales(local: Floats, totals: Floats, parents: Ints) -> Floats:
    """Return joint-to-parent transforms (..., N, 4, 4) whose spaces are no longer scaled by `totals` (N,).

    With the inverse of `totals` they are scaled again.
    """
    result = np.array(local)
    result[..., :3, :3] *= (_above(totals, parents) / totals)[:, None, None]
    return spread_out(result, totals, parents)


def spread_out(local: Floats, totals: Floats, parents: Ints) -> Floats:
    """Return joint-to-parent transforms (..., N, 4, 4) that turn alike, with the lengths of parents without scale."""
    result = np.array(local)
    result[..., :3, 3] *= _above(totals, parents)[:, None]
    return result


def _above(totals: Floats, parents: Ints) -> Floats:
    return np.where(np.asarray(parents) >= 0, totals[parents], 1.0)


def divided(transforms: Floats, totals: Floats) -> Floats:
    """Return joint-to-bind or -skeleton transforms (..., N, 4, 4), each divided by its factor from the right."""
    result = np.array(transforms)
    result[..., :3, :3] /= totals[:, None, None]
    return result
