# SPDX-License-Identifier: Apache-2.0
"""Motions that repeat, such as a walk: after how many frames, where a round leads, and rounds one after the other.

The last frame of a cycle shows the pose of the first, or the pose one frame before it; the nearer of both counts. A
round may lead elsewhere and turn about the vertical. That is the rigid motion of least squares over the joints, which
stand as four points each, so that where they point counts as well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .assets import Floats, Motion, Skeleton
from .kinematics import motion_transforms, multiply_quaternions, quaternion_from_matrix, slerp

LEAST_FRAMES = 4
ARMS = 0.05  # of the size that is given, the length at which a joint's axes count


@dataclass(frozen=True, eq=False)
class Cycle:
    """How a motion repeats.

    Attributes:
        frames: after which it does.
        closed: whether its last frame shows the pose of the first, else the one before that.
        angle: by which a round turns about the vertical [rad].
        step: with that turn about the origin, where a round leads [m], shape (3,).
        gap: distance between where the last frames lead and the first frame, of the joint that misses it most [m].
    """

    frames: int
    closed: bool
    angle: float
    step: Floats
    gap: float

    @property
    def turn(self) -> Floats:
        """Rotation by `angle` about the vertical, shape (3, 3)."""
        return _turn(self.angle)

    def back(self, points: Floats) -> Floats:
        """Return points (..., 3) of a round's end in the place of its beginning."""
        return (points - self.step) @ self.turn

    def travel(self, place: Floats) -> float:
        """Return how far a round takes a point (3,) [m]."""
        return float(np.linalg.norm(self.turn @ place + self.step - place))


def find_cycle(motion: Motion, skeleton: Skeleton, size: float) -> Cycle:
    """Return how a motion repeats best; whether it does, `Cycle.gap` says.

    Args:
        size: of the character or its garment [m].

    Raises:
        ValueError: it has fewer frames than `LEAST_FRAMES`.
    """
    if motion.frame_count < LEAST_FRAMES:
        raise ValueError(f"{motion.frame_count} frames")
    ends = motion.picked(np.array([0, 1, 2, -2, -1]))
    world = motion_transforms(ends, skeleton.parents)
    arms = np.concatenate([np.zeros((1, 3)), ARMS * size * np.eye(3)])
    points = np.einsum("fjab,kb->fjka", world[..., :3, :3], arms) + world[..., None, :3, 3]
    first, second, third, before, last = points.reshape(len(points), -1, 3)
    (angle, step), gap = _between(first, last)
    closed = Cycle(motion.frame_count - 1, True, angle, step, gap)
    # On a cubic through frames a, b, c, d, e the one between is c = (-a + 4 b + 4 d - e) / 6, which gives each side.
    (angle, step), gap = _between((6 * first - 4 * second + third) / 3, (4 * last - before) / 3)
    opened = Cycle(motion.frame_count, False, angle, step, gap)
    return closed if closed.gap <= opened.gap else opened


def rounds(motion: Motion, skeleton: Skeleton, cycle: Cycle, count: int) -> Motion:
    """Return so many rounds of a motion, one after the other, each led on by the one before.

    What the last frame misses the first by is spread over the round, so that no joint jumps. Gravity, if the motion
    has any, is the same in all rounds; what it sees of colliders turns along.
    """
    own = motion.picked(slice(0, cycle.frames))
    if cycle.closed:
        own = _closed(motion, skeleton, cycle)
    number = np.repeat(np.arange(count), cycle.frames)
    many = own.picked(np.tile(np.arange(cycle.frames), count))
    turns, places = _turn(cycle.angle * np.arange(count)), np.zeros((count, 3))
    for each in range(1, count):
        places[each] = cycle.turn @ places[each - 1] + cycle.step
    rotations, translations = many.rotations.copy(), many.translations.copy()
    roots, half = np.flatnonzero(skeleton.parents < 0), cycle.angle * number / 2
    about = np.stack([np.cos(half), 0 * half, np.sin(half), 0 * half], axis=-1)[:, None]
    rotations[:, roots] = multiply_quaternions(about, rotations[:, roots])
    turned = np.einsum("fab,fjb->fja", turns[number], translations[:, roots])
    translations[:, roots] = turned + places[number][:, None]
    felt: dict[str, Any] = {}
    if many.proximity is not None:
        seen = many.proximity.copy()
        seen[..., :3] = np.einsum("fab,fmb->fma", turns[number], seen[..., :3])
        felt = {"proximity": seen}
    return replace(many, rotations=rotations, translations=translations, **felt)


def led(motion: Motion, skeleton: Skeleton, cycle: Cycle, period: int) -> Motion:
    """Return a round with one frame more before it: the last of a round that leads up to it.

    Args:
        motion: frames of a round, at any rate.
        period: after how many of them it repeats.
    """
    own = motion.picked(np.array([period - 1, *range(motion.frame_count)]))
    rotations, translations, roots = own.rotations.copy(), own.translations.copy(), skeleton.parents < 0
    back = np.array([np.cos(cycle.angle / 2), 0.0, -np.sin(cycle.angle / 2), 0.0])
    rotations[0, roots] = multiply_quaternions(back, rotations[0, roots])
    translations[0, roots] = cycle.back(translations[0, roots])
    return replace(own, rotations=rotations, translations=translations, start=motion.start - 1)


def _closed(motion: Motion, skeleton: Skeleton, cycle: Cycle) -> Motion:
    """Return the frames of a round with what the last one misses spread over them."""
    ends = motion.picked(np.array([0, -1]))
    rotations, translations = ends.rotations, ends.translations.copy()
    wanted, place = rotations[0].copy(), translations[0].copy()
    roots = skeleton.parents < 0
    wanted[roots] = multiply_quaternions(quaternion_from_matrix(cycle.turn), wanted[roots])
    place[roots] = place[roots] @ cycle.turn.T + cycle.step
    inverse = rotations[1] * np.array([1.0, -1.0, -1.0, -1.0])
    missing = multiply_quaternions(inverse, wanted)
    share = (np.arange(cycle.frames) / cycle.frames)[:, None]
    none = np.broadcast_to(np.array([1.0, 0.0, 0.0, 0.0]), missing.shape)
    own = motion.picked(slice(0, cycle.frames))
    felt: dict[str, Any] = {}
    if own.shape_weights is not None and motion.shape_weights is not None:
        left = motion.shape_weights[0] - motion.shape_weights[-1]
        felt = {"shape_weights": own.shape_weights + share * left}
    return replace(
        own,
        rotations=multiply_quaternions(own.rotations, slerp(none, missing, share)),
        translations=own.translations + share[..., None] * (place - translations[1]),
        **felt,
    )


def _between(points: Floats, targets: Floats) -> tuple[tuple[float, Floats], float]:
    """Return the angle about the vertical and the step that take points (N, 3) nearest to targets, and what is left
    of the farthest of them [m]."""
    middle, goal = points.mean(axis=0), targets.mean(axis=0)
    a, b = points - middle, targets - goal
    along = (a[:, 0] * b[:, 0] + a[:, 2] * b[:, 2]).sum()
    across = (a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]).sum()
    angle = float(np.arctan2(across, along))
    turn = _turn(angle)
    step = goal - turn @ middle
    return (angle, step), float(np.linalg.norm(points @ turn.T + step - targets, axis=1).max())


def _turn(angle: float | Floats) -> Floats:
    """Return rotations about the vertical, shape (..., 3, 3)."""
    cosine, sine = np.cos(angle), np.sin(angle)
    zero, one = 0 * cosine, 0 * cosine + 1
    rows = [[cosine, zero, sine], [zero, one, zero], [-sine, zero, cosine]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
