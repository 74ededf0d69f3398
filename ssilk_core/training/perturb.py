# SPDX-License-Identifier: Apache-2.0
"""Motions with joints turned at random, for poses that no clip holds: flips, falls, glitches of motion capture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..assets import Floats, Motion
from ..kinematics import multiply_quaternions

USUAL_TURN, LARGE_TURN = np.radians(12), np.radians(35)  # standard deviation about each axis
LARGE_PROBABILITY = 0.1  # that a joint turns far
SLOWEST, FASTEST = 0.1, 0.7  # [Hz] of the turns


def perturb_motions(motions: Sequence[Motion], copies: int, seed: int) -> list[Motion]:
    """Return `copies` of each motion with slow random turns of every joint but the root, about random axes."""
    generator = np.random.default_rng(seed)
    return [_perturbed(motion, generator) for motion in [*motions] * copies]


def _perturbed(motion: Motion, generator: np.random.Generator) -> Motion:
    count = motion.rotations.shape[1]
    far = generator.random((count, 1)) < LARGE_PROBABILITY
    size = np.where(far, LARGE_TURN, USUAL_TURN)
    still, swing = (size * generator.normal(size=(count, 3)) / np.sqrt(2) for _ in range(2))
    rate, phase = generator.uniform(SLOWEST, FASTEST, (count, 1)), generator.uniform(0, 2 * np.pi, (count, 1))
    time = np.arange(motion.frame_count)[:, None, None] / motion.fps
    turns = still + np.sqrt(2) * swing * np.sin(2 * np.pi * rate * time + phase)
    turns[:, 0] = 0
    rotations = multiply_quaternions(motion.rotations, _quaternions(turns))
    return replace(motion, path=f"{motion.path} perturbed", rotations=rotations)


def _quaternions(turns: Floats) -> Floats:
    """Return the quaternions (..., 4) of rotation vectors (..., 3) [rad]."""
    half = 0.5 * np.linalg.norm(turns, axis=-1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * turns], axis=-1)
