# SPDX-License-Identifier: Apache-2.0
"""More motions from those at hand: limbs of one clip on the body of another.

A few minutes of capture hold few combinations of what arms, legs and spine do, and a garment trained on them meets
others in every shot. Each limb still moves as it was captured, and so does the root.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..assets import Floats, Ints, Motion, Skeleton
from ..kinematics import resample

SHARE = 0.4  # of the limbs of a clip that another one moves


def recombined(motions: Sequence[Motion], skeleton: Skeleton, copies: int, seed: int) -> list[Motion]:
    """Return up to `copies` more of each motion, in each of which some limbs move as in another motion."""
    limbs, generator, more = limb_joints(skeleton), np.random.default_rng(seed), []
    for base in [*motions] * copies:
        chosen = [limb for limb in limbs if generator.random() < SHARE]
        donor = motions[generator.integers(len(motions))]
        start = int(generator.integers(donor.frame_count))
        if chosen and donor is not base:
            more.append(with_limbs(base, donor, np.unique(np.concatenate(chosen)), start))
    return more


def limb_joints(skeleton: Skeleton) -> list[Ints]:
    """Return the joints of every limb: those below each joint that has siblings."""
    parents = np.asarray(skeleton.parents)
    children = np.bincount(parents[parents >= 0], minlength=len(parents))
    heads = [joint for joint, parent in enumerate(parents) if parent >= 0 and children[parent] > 1]
    return [np.flatnonzero(_below(parents, head)) for head in heads]


def _below(parents: Ints, head: int) -> Floats:
    """Flag a joint and all under it, shape (J,)."""
    flags = np.zeros(len(parents), dtype=bool)
    for joint, parent in enumerate(parents):  # parents come first
        flags[joint] = joint == head or (parent >= 0 and flags[parent])
    return flags


def with_limbs(base: Motion, donor: Motion, joints: Ints, start: int) -> Motion:
    """Return `base` with these joints turning as in `donor` from its frame `start` on, to and fro at its ends."""
    turns = resample(donor, base.fps).rotations
    last = len(turns) - 1
    frames = (start + np.arange(base.frame_count)) % max(1, 2 * last)
    rotations = base.rotations.copy()
    rotations[:, joints] = turns[np.where(frames > last, 2 * last - frames, frames)][:, joints]
    return replace(base, path=f"{base.path} with limbs of {donor.path}", rotations=rotations)
