# SPDX-License-Identifier: Apache-2.0
"""Fewer proxy joints: ends of chains are taken off, those that are missed least first.

Only ends, so that all that stay move as before: a joint within a chain carries those after it. What a joint moved
follows the one that carried it, in the same shares, which leaves cloth as smooth as it was. Weights fitted anew for
each vertex come nearer by themselves, but neighbours part; and what is lost smoothly is what blendshapes can make up
for: on the cape with 10 of 20 proxies they then leave half as much.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..assets import Floats, Ints, Scene
from .influences import InfluenceCandidates


def candidates(scene: Scene, weights: Floats) -> Ints:
    """Return for each vertex the joints that move it and those that carry these, down to the character's.

    Args:
        weights: of all joints, shape (V, J + P).

    Returns:
        Joints (V, C), rows filled up with -1.
    """
    character = scene.character.skeleton.joint_count
    wanted = weights > 0
    for proxy in reversed(range(character, len(scene.parents))):
        wanted[:, scene.parents[proxy]] |= wanted[:, proxy]
    width = int(wanted.sum(axis=1).max())
    order = np.argsort(~wanted, axis=1, kind="stable")[:, :width]
    return np.where(np.take_along_axis(wanted, order, axis=1), order, -1)


def least_missed(scene: Scene, influences: InfluenceCandidates, mass: Floats) -> list[int]:
    """Return all proxies in the order in which to take them off, as combined joint indices.

    Args:
        mass: of the vertices, shape (V,).
    """
    character = scene.character.skeleton.joint_count
    order: list[int] = []
    kept = set(range(character, len(scene.parents)))
    while kept:
        ends = sorted(kept - {int(scene.parents[proxy]) for proxy in kept})
        gone = min(ends, key=lambda end: _missed(influences, scene.parents, mass, [*order, end]))
        order.append(gone)
        kept.remove(gone)
    return order


def _missed(influences: InfluenceCandidates, parents: Ints, mass: Floats, gone: list[int]) -> float:
    """Return what the vertices that the last of these joints moves lose more by its going [m2, weighted by mass]."""
    rows = np.flatnonzero((influences.joints == gone[-1]).any(axis=1))
    own = influences.of(rows)
    before, after = (own.lost(handed_down(own, parents, gone[:count])) for count in (-1, len(gone)))
    return float(mass[rows] @ (after - before))


def handed_down(influences: InfluenceCandidates, parents: Ints, gone: list[int]) -> Floats:
    """Return weights (V, C) with those of some joints given to what carries them.

    Args:
        parents: of all joints; gone: ends of chains first.
    """
    weights = influences.weights.copy()
    for joint in gone:
        row, column = np.nonzero(influences.joints == joint)
        above = (influences.joints[row] == parents[joint]).argmax(axis=1)
        weights[row, above] += weights[row, column]
        weights[row, column] = 0
    return weights


def dense(joints: Ints, weights: Floats, count: int) -> NDArray:
    """Return weights over candidates (V, C) as those of all joints (V, count)."""
    matrix = np.zeros((len(joints), count + 1))  # the last column takes the candidates that there are not
    np.add.at(matrix, (np.arange(len(joints))[:, None], joints), weights)
    return matrix[:, :count]
