# SPDX-License-Identifier: Apache-2.0
"""Motions with joints turned at random, nearer to the bind pose, or turning over, as few clips have them.

Random turns stand for falls and glitches of motion capture. Many joints near the bind pose at once, such as the
spine, the shoulders and the hands, stand for motions that are keyed by hand. Where the whole body turns over, as in
flips, gravity changes its direction within a second.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..physics.constants import GRAVITY
from ..scene.assets import Floats, Ints, Motion, Skeleton
from ..scene.kinematics import bind_pose, matrix_from_quaternion, motion_transforms, multiply_quaternions, slerp
from .recombine import limb_joints

USUAL_TURN, LARGE_TURN = np.radians(12), np.radians(35)  # standard deviation about each axis
LARGE_PROBABILITY = 0.1  # that a joint turns far
BLEND_PROBABILITY = 0.5  # that a motion is blended with the bind pose
WHOLE_PROBABILITY = 0.5  # that a limb of a blended motion goes all the way; others go a part of it
FADING_ANGLE = np.radians(120)  # from the bind pose; beyond it a joint goes less far, and at 180 degrees not at all
SLOWEST, FASTEST = 0.1, 0.7  # [Hz] of the turns and blends
TUMBLE_SECONDS = 0.6, 1.6  # [s] that a turn takes, and that lie between two turns
HOP_PROBABILITY = 0.5  # that the body flies freely in a turn
FLIGHT_SECONDS = 0.4, 0.9  # [s] from the middle of the push to that of the landing
PUSH_SECONDS = 0.2  # [s] in which the ground speeds the body up, and slows it down again


def perturb_motions(
    motions: Sequence[Motion], skeleton: Skeleton, copies: int, seed: int, tumbling: float
) -> list[Motion]:
    """Return `copies` of each motion with slow random turns of the joints within the body, about random axes.

    About half of the copies then go to and fro between these poses and the bind pose, each limb its own part of the
    way. A share `tumbling` turns as a whole, about the middle of its joints and random axes, again and again.
    """
    generator = np.random.default_rng(seed)
    bind, limbs = bind_pose(skeleton)[0], limb_joints(skeleton)
    found = [_perturbed(motion, skeleton, bind, limbs, generator) for motion in [*motions] * copies]
    return [_tumbling(motion, skeleton, generator) if generator.random() < tumbling else motion for motion in found]


def _perturbed(
    motion: Motion, skeleton: Skeleton, bind: Floats, limbs: Sequence[Ints], generator: np.random.Generator
) -> Motion:
    whole = [0, *skeleton.hub_path]  # what moves the character as a whole
    rotations = multiply_quaternions(motion.rotations, _quaternions(_turns(motion, whole, generator)))
    if generator.random() < BLEND_PROBABILITY:
        rotations = _towards(rotations, bind, _bind_weights(motion, whole, limbs, generator))
    return replace(motion, path=f"{motion.path} perturbed", rotations=rotations)


def _tumbling(motion: Motion, skeleton: Skeleton, generator: np.random.Generator) -> Motion:
    """Return a motion that turns as a whole, once and again, and at times flies freely meanwhile."""
    time, start = np.arange(motion.frame_count) / motion.fps, generator.uniform(0, TUMBLE_SECONDS[1])
    turn, height = np.tile([1.0, 0, 0, 0], (motion.frame_count, 1)), np.zeros(motion.frame_count)
    while start < time[-1]:
        lasts, axis = generator.uniform(*TUMBLE_SECONDS), generator.normal(size=3)
        part = ((time - start) / lasts).clip(0, 1)
        angle = 2 * np.pi * part**2 * (3 - 2 * part)  # ends as it began, at rest
        turn = multiply_quaternions(_quaternions(angle[:, None] * axis / np.linalg.norm(axis)), turn)
        if generator.random() < HOP_PROBABILITY:
            flight = generator.uniform(*FLIGHT_SECONDS)
            height += _hop(time - start - (lasts - flight) / 2, flight)
        start += lasts + generator.uniform(*TUMBLE_SECONDS)
    rotations, translations = motion.rotations.copy(), motion.translations.copy()
    middle = motion_transforms(motion, skeleton.parents)[:, :, :3, 3].mean(axis=1)
    for root in np.flatnonzero(skeleton.parents < 0):
        rotations[:, root] = multiply_quaternions(turn, rotations[:, root])
        away = matrix_from_quaternion(turn) @ (translations[:, root] - middle)[..., None]
        translations[:, root] = middle + away[..., 0]
        translations[:, root, 1] += height
    return replace(motion, rotations=rotations, translations=translations)


def _hop(time: Floats, flight: float) -> Floats:
    """Return heights [m] at times since the middle of a push [s] from which the body flies so long."""
    since = time[:, None] + np.linspace(-0.5, 0.5, 65) * PUSH_SECONDS
    return (0.5 * GRAVITY * since * (flight - since)).clip(min=0).mean(axis=1)


def _turns(motion: Motion, whole: list[int], generator: np.random.Generator) -> Floats:
    """Return rotation vectors (F, J, 3) [rad] that change slowly; those of joints `whole` are zero."""
    count = motion.rotations.shape[1]
    far = generator.random((count, 1)) < LARGE_PROBABILITY
    size = np.where(far, LARGE_TURN, USUAL_TURN)
    still, swing = (size * generator.normal(size=(count, 3)) / np.sqrt(2) for _ in range(2))
    turns = still + np.sqrt(2) * swing * _waves(motion, generator, count)[..., None]
    turns[:, whole] = 0
    return turns


def _towards(rotations: Floats, bind: Floats, weights: Floats) -> Floats:
    """Return rotations (F, J, 4) on their way to those of the bind pose, without jumps at its far side."""
    half = np.arccos(np.abs((rotations * bind).sum(axis=-1)).clip(max=1))
    fading = (np.pi / 2 - half) / (np.pi / 2 - FADING_ANGLE / 2)
    return slerp(rotations, bind, weights * fading.clip(0, 1))


def _bind_weights(motion: Motion, whole: list[int], limbs: Sequence[Ints], generator: np.random.Generator) -> Floats:
    """Return how far joints but `whole` are on their way to the bind pose, from 0 to 1, shape (F, J)."""
    parts = np.ones(motion.rotations.shape[1])
    for joints in limbs:  # outer limbs come last
        parts[joints] = 1 if generator.random() < WHOLE_PROBABILITY else generator.random()
    parts[whole] = 0
    return (0.5 + 0.5 * _waves(motion, generator, 1)) * parts


def _waves(motion: Motion, generator: np.random.Generator, count: int) -> Floats:
    """Return sines of random rates and phases, shape (F, `count`)."""
    rate, phase = generator.uniform(SLOWEST, FASTEST, count), generator.uniform(0, 2 * np.pi, count)
    time = np.arange(motion.frame_count)[:, None] / motion.fps
    return np.sin(2 * np.pi * rate * time + phase)


def _quaternions(turns: Floats) -> Floats:
    """Return the quaternions (..., 4) of rotation vectors (..., 3) [rad]."""
    half = 0.5 * np.linalg.norm(turns, axis=-1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * turns], axis=-1)
