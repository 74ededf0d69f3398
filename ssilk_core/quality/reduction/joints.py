# SPDX-License-Identifier: Apache-2.0
"""Fewer proxy joints: ends of chains are removed, in order of increasing error.

Only ends of chains are removed, so that the remaining joints move as before. The weights of a removed joint go to its
parent, which keeps the cloth smooth. Refitting the weights of each vertex has less error at first, but separates
neighbouring vertices. A smooth error can be compensated by blendshapes: on the cape with 10 of 20 proxies the
remaining error is then half as large.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from ...scene.assets import Floats, Ints, Scene
from .influences import InfluenceCandidates


def candidate_joints(scene: Scene, weights: Floats) -> Ints:
    """Return for each vertex the joints that move it and their ancestors, up to the character's joints.

    Args:
        weights: of all joints, shape (V, J + P).

    Returns:
        Joints (V, C), rows padded with -1.
    """
    character = scene.character.skeleton.joint_count
    wanted = weights > 0
    for proxy in reversed(range(character, len(scene.parents))):
        wanted[:, scene.parents[proxy]] |= wanted[:, proxy]
    width = int(wanted.sum(axis=1).max())
    order = np.argsort(~wanted, axis=1, kind="stable")[:, :width]
    return np.where(np.take_along_axis(wanted, order, axis=1), order, -1)


def with_those_above(scene: Scene, names: Collection[str]) -> frozenset[int]:
    """Return the proxies of these joint paths and those that they hang from, as combined joint indices."""
    character, found = scene.character.skeleton.joint_count, set[int]()
    for proxy in reversed(range(character, len(scene.parents))):
        if scene.joint_names[proxy] in names or proxy in found:
            found |= {proxy, int(scene.parents[proxy])}
    return frozenset(proxy for proxy in found if proxy >= character)


def removal_order(
    scene: Scene, influences: InfluenceCandidates, mass: Floats, held: Collection[int] = ()
) -> list[int]:
    """Return the proxies in order of removal, as combined joint indices.

    Args:
        mass: of the vertices, shape (V,).
        held: proxies that stay, with all that they hang from.
    """
    character = scene.character.skeleton.joint_count
    order: list[int] = []
    kept = set(range(character, len(scene.parents))).difference(held)
    while kept:
        ends = sorted(kept - {int(scene.parents[proxy]) for proxy in kept})
        gone = min(ends, key=lambda end: _missed(influences, scene.parents, mass, [*order, end]))
        order.append(gone)
        kept.remove(gone)
    return order


def _missed(influences: InfluenceCandidates, parents: Ints, mass: Floats, gone: list[int]) -> float:
    """Return the additional error from removing the last of these joints [m2, weighted by mass]."""
    rows = np.flatnonzero((influences.joints == gone[-1]).any(axis=1))
    own = influences.of(rows)
    before, after = (own.error(move_to_parents(own, parents, gone[:count])) for count in (-1, len(gone)))
    return float(mass[rows] @ (after - before))


def move_to_parents(influences: InfluenceCandidates, parents: Ints, gone: list[int]) -> Floats:
    """Return weights (V, C) with those of removed joints moved to their parents.

    Args:
        parents: of all joints; gone: removed joints, ends of chains first.
    """
    weights = influences.weights.copy()
    for joint in gone:
        row, column = np.nonzero(influences.joints == joint)
        above = (influences.joints[row] == parents[joint]).argmax(axis=1)
        weights[row, above] += weights[row, column]
        weights[row, column] = 0
    return weights


def dense(joints: Ints, weights: Floats, count: int) -> NDArray:
    """Return weights over candidates (V, C) as weights of all joints (V, count)."""
    matrix = np.zeros((len(joints), count + 1))  # the last column collects the padding
    np.add.at(matrix, (np.arange(len(joints))[:, None], joints), weights)
    return matrix[:, :count]
