# SPDX-License-Identifier: Apache-2.0
"""Motions as functions of time, and functions that modify them.

A motion is sampled block by block during playback, so its length does not affect memory. A modification, such as a
spin or a teleport, wraps a motion and returns a new one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ...scene.assets import Floats, Motion, Skeleton
from ...scene.kinematics import bind_pose, hub_places, multiply_quaternions, sample_motion, slerp

BLOCK = 256  # frames
SWAY = 4.0  # [s] period of the procedural motion

Sampled = tuple[Floats, Floats]  # rotations (N, J, 4) and translations (N, J, 3) [m]
Turn = Callable[[Floats], Floats]  # times [s] (N,) to quaternions (N, 4)


@dataclass(frozen=True, eq=False)
class ProceduralMotion:
    """A motion of `frames` frames at `fps`, where `at` returns rotations and translations at times [s] (N,).

    `loop` is its period [s], or zero if it does not repeat; `felt` what cloth feels in each frame (`Motion.felt`).
    """

    fps: float
    frames: int
    at: Callable[[Floats], Sampled]
    loop: float = 0.0
    felt: Mapping[str, Any] = field(default_factory=dict)

    def motion(self, start: int = 0, stop: int | None = None) -> Motion:
        """Return the frames from `start` to `stop` (exclusive), by default all.

        Raises:
            SsilkError: a frame has NaN.
        """
        stop = self.frames if stop is None else min(stop, self.frames)
        felt = {name: values[start:stop] for name, values in self.felt.items()}
        return Motion("stress", self.fps, *self.at(np.arange(start, stop) / self.fps), start, **felt)

    def blocks(self, size: int = BLOCK) -> Iterator[Motion]:
        """Yield all frames, `size` at a time."""
        for start in range(0, self.frames, size):
            yield self.motion(start, start + size)

    def with_duration(self, seconds: float, fps: float | None = None) -> ProceduralMotion:
        """Return the motion with a duration [s] and, optionally, another frame rate [1/s]."""
        fps = fps or self.fps
        return replace(self, fps=fps, frames=round(seconds * fps) + 1)

    def with_loops(self, seconds: float) -> ProceduralMotion:
        """Return the motion with a whole number of loops, at least three, that last at least `seconds`."""
        loops = max(3, int(np.ceil(seconds / self.loop)))
        return self.with_duration(loops * self.loop)

    def then(self, change: Callable[[Floats, Floats, Floats], Sampled]) -> ProceduralMotion:
        """Return the motion modified by a function of (times, rotations, translations)."""
        return replace(self, at=lambda times: change(times, *self.at(times)))


def sway(skeleton: Skeleton, fps: float) -> ProceduralMotion:
    """Return a looping motion in which every joint rotates by its own sines about the bind pose."""
    random, loop = np.random.default_rng(0), SWAY
    rest, places = bind_pose(skeleton)
    turns = random.integers(1, 4, (skeleton.joint_count, 3)) * 2 * np.pi / loop  # [rad/s]
    phase, size = random.uniform(0, 6, turns.shape), random.uniform(0.05, 0.25, turns.shape)

    def at(times: Floats) -> Sampled:
        half = size * np.sin(times[:, None, None] * turns + phase)
        turn = np.concatenate([np.ones((*half.shape[:2], 1)), half], axis=-1)
        moved = np.tile(places, (len(times), 1, 1))
        moved[:, skeleton.hub_path[0], 0] += 0.3 * np.sin(times * 2 * np.pi / loop)
        return multiply_quaternions(rest, turn / np.linalg.norm(turn, axis=-1, keepdims=True)), moved

    return ProceduralMotion(fps, 1, at, loop)


def loop_clip(motion: Motion, fps: float) -> ProceduralMotion:
    """Return a clip played forward and backward with eased ends; a loop has a whole number of frames at `fps`."""
    last = motion.frame_count - 1
    loop = max(1, round(np.pi * last / motion.fps * fps)) / fps  # the middle of the clip keeps its speed

    def at(times: Floats) -> Sampled:
        return sample_motion(motion, last * (1 - np.cos(2 * np.pi * times / loop)) / 2)

    return ProceduralMotion(fps, 1, at, loop)


def rotate_character(drive: ProceduralMotion, skeleton: Skeleton, turn: Turn) -> ProceduralMotion:
    """Rotate the character about its hub by a function of time."""
    roots = np.flatnonzero(skeleton.parents < 0)

    def change(times: Floats, rotations: Floats, translations: Floats) -> Sampled:
        rotations, translations = rotations.copy(), translations.copy()
        q, centre = turn(times)[:, None], hub_places(skeleton, rotations, translations)[:, None]
        rotations[:, roots] = multiply_quaternions(q, rotations[:, roots])
        translations[:, roots] = centre + rotate_vectors(q, translations[:, roots] - centre)
        return rotations, translations

    return drive.then(change)


def rotate_vectors(quaternions: Floats, vectors: Floats) -> Floats:
    """Rotate vectors (..., 3) by unit quaternions (..., 4)."""
    pure = np.concatenate([np.zeros_like(vectors[..., :1]), vectors], axis=-1)
    inverse = quaternions * [1, -1, -1, -1]
    return multiply_quaternions(multiply_quaternions(quaternions, pure), inverse)[..., 1:]


def about(axis: tuple[float, float, float], speed: float = 0.0, angle: float = 0.0) -> Turn:
    """Return a rotation about a unit axis from an initial angle [rad] at a constant speed [rad/s]."""

    def turn(times: Floats) -> Floats:
        half = (angle + speed * times)[:, None] / 2
        return np.concatenate([np.cos(half), np.sin(half) * axis], axis=1)

    return turn


def translate_character(
    drive: ProceduralMotion, path: Callable[[Floats], Floats], skeleton: Skeleton
) -> ProceduralMotion:
    """Translate the character along a path: times [s] (N,) to offsets [m] (N, 3)."""
    roots = np.flatnonzero(skeleton.parents < 0)

    def change(times: Floats, rotations: Floats, translations: Floats) -> Sampled:
        translations = translations.copy()
        translations[:, roots] += path(times)[:, None]
        return rotations, translations

    return drive.then(change)


def freeze_after(drive: ProceduralMotion, time: float) -> ProceduralMotion:
    """Freeze the motion at its pose at a time [s]."""
    return replace(drive, at=lambda times: drive.at(np.minimum(times, time)))


def randomize_rotations(drive: ProceduralMotion, skeleton: Skeleton, every: float) -> ProceduralMotion:
    """Replace the rotations of all joints but roots and the hub by random ones on SO(3) every `every` seconds."""
    random, inner = np.random.default_rng(1), np.asarray(skeleton.parents) >= 0
    inner[list(skeleton.hub_path)] = False
    keys = random.normal(size=(64, skeleton.joint_count, 4))
    keys /= np.linalg.norm(keys, axis=-1, keepdims=True)

    def change(times: Floats, rotations: Floats, translations: Floats) -> Sampled:
        step, part = np.divmod(times / every, 1)
        low = step.astype(int) % len(keys)
        mixed = slerp(keys[low], keys[(low + 1) % len(keys)], part[:, None])
        return np.where(inner[:, None], mixed, rotations), translations

    return drive.then(change)


def insert_nan(drive: ProceduralMotion, frame: int) -> ProceduralMotion:
    """Replace all rotations of one frame by NaN."""

    def change(times: Floats, rotations: Floats, translations: Floats) -> Sampled:
        hit = np.isclose(times * drive.fps, frame)[:, None, None]
        return np.where(hit, np.nan, rotations), translations

    return drive.then(change)


def scale_motion(drive: ProceduralMotion, scale: float) -> ProceduralMotion:
    """Scale the motion for a character that is `scale` times as large."""
    return drive.then(lambda times, rotations, translations: (rotations, scale * translations))
