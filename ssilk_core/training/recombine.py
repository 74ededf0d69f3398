# SPDX-License-Identifier: Apache-2.0
"""More motions from those at hand: limbs of one clip on the body of another.

A few minutes of motion capture hold few combinations of arm, leg and spine motions, and every shot has others. In a
recombined motion each limb, and the root, still moves as captured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..scene.assets import Floats, Ints, Motion, Skeleton
from ..scene.kinematics import resample

LIMB_PROBABILITY = 0.4  # that a limb moves as in another clip


def recombine_motions(motions: Sequence[Motion], skeleton: Skeleton, copies: int, seed: int) -> list[Motion]:
    """Return up to `copies` variants of each motion, in which some limbs move as in another motion."""
    limbs, generator, more = limb_joints(skeleton), np.random.default_rng(seed), []
    for base in [*motions] * copies:
        chosen = [limb for limb in limbs if generator.random() < LIMB_PROBABILITY]
        donor = motions[generator.integers(len(motions))]
        start = int(generator.integers(donor.frame_count))
        if chosen and donor is not base:
            more.append(replace_limbs(base, donor, np.unique(np.concatenate(chosen)), start))
    return more


def limb_joints(skeleton: Skeleton) -> list[Ints]:
    """Return the joints of every limb: each joint that has siblings, with its descendants; the body is none."""
    parents = np.asarray(skeleton.parents)
    children = np.bincount(parents[parents >= 0], minlength=len(parents))
    heads = [
        joint
        for joint, parent in enumerate(parents)
        if parent >= 0 and children[parent] > 1 and joint not in skeleton.hub_path
    ]
    return [np.flatnonzero(_below(parents, head)) for head in heads]


def _below(parents: Ints, head: int) -> Floats:
    """Flag a joint and its descendants, shape (J,)."""
    flags = np.zeros(len(parents), dtype=bool)
    for joint, parent in enumerate(parents):  # parents come first
        flags[joint] = joint == head or (parent >= 0 and flags[parent])
    return flags


def replace_limbs(base: Motion, donor: Motion, joints: Ints, start: int) -> Motion:
    """Return `base` with rotations of some joints from frame `start` of `donor` on, mirrored at its ends."""
    turns = resample(donor, base.fps).rotations
    last = len(turns) - 1
    frames = (start + np.arange(base.frame_count)) % max(1, 2 * last)
    rotations = base.rotations.copy()
    rotations[:, joints] = turns[np.where(frames > last, 2 * last - frames, frames)][:, joints]
    return replace(base, path=f"{base.path} with limbs of {donor.path}", rotations=rotations)
