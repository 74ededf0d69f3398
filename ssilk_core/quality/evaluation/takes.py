# SPDX-License-Identifier: Apache-2.0
"""Takes: parts of clips without cuts, at a model's rate, and clips that loop or stop."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from ...physics.simulate.characters import split_into_spans
from ...scene.assets import Floats, Motion, Skeleton
from ...scene.kinematics import sample_motion

EASE = 0.25  # [s] to start or to stop
SHORTEST = 4  # frames; a third difference needs as many


@dataclass(frozen=True, eq=False)
class Take:
    """A part of a clip without cuts.

    Attributes:
        clip: its name.
        first: frame of the clip that it begins with, at the rate of `motion`.
        motion: the character's poses at the model's rate.
        start, step: frame of the clip's file that the clip begins with, and frames of the file from one frame of the
            take to the next. They are time codes where a frame of the file is one.
    """

    clip: str
    first: int
    motion: Motion
    start: float = 0.0
    step: float = 1.0

    @property
    def frame_count(self) -> int:
        return self.motion.frame_count

    @property
    def codes(self) -> Floats:
        """When each frame is in the clip's file, shape (F,)."""
        return self.start + (self.first + np.arange(self.frame_count)) * self.step


def takes_of(clip: str, motion: Motion, skeleton: Skeleton, fps: float, longest: int | None = None) -> list[Take]:
    """Return a clip at `fps` as takes of at most `longest` frames; those of under four frames are left out.

    Frames are those of `ssilk simulate` at the same rate, so that a point cache of the clip lines up.
    """
    spans = split_into_spans(motion, skeleton, 0, fps, 1, longest)
    clock = motion.start, motion.fps / fps
    return [Take(clip, span.first, span.motion, *clock) for span in spans if span.motion.frame_count >= SHORTEST]


def within(takes: Iterable[Take], frames: int) -> list[Take]:
    """Return takes as far as they lie in the first frames of their clips; those of under four are left out."""
    begun = [take for take in takes if frames - take.first >= SHORTEST]
    return [replace(take, motion=take.motion.clip(0, frames - take.first)) for take in begun]


def _played(motion: Motion, fps: float, seconds: Floats) -> Motion:
    position = np.clip(seconds * motion.fps, 0, motion.frame_count - 1)
    return Motion(motion.path, fps, *sample_motion(motion, position))


def back_and_forth(motion: Motion, fps: float, frames: int) -> tuple[Motion, int]:
    """Loop a clip forward and backward and return at least `frames` frames, with the length of a loop.

    Speed falls to zero and rises again within `EASE` at either end, so that positions and velocities are continuous
    and each loop is exactly the one before it.
    """
    duration = (motion.frame_count - 1) / motion.fps
    half = round((duration + EASE) * fps)
    time = np.linspace(0, duration + EASE, half + 1)
    first = np.minimum(time, EASE) ** 2 / (2 * EASE) + np.maximum(time - EASE, 0)
    late = np.maximum(time - duration, 0)  # the mirror image of the start
    there = first - late**2 / (2 * EASE)
    loop = np.concatenate([there, there[-2:0:-1]])
    return _played(motion, fps, np.tile(loop, -(-frames // len(loop)))), len(loop)


def stopped(motion: Motion, fps: float, stop: float, hold: float) -> tuple[Motion, int]:
    """Play a clip until `stop` [s], come to rest within `EASE`, and hold that pose for `hold` seconds.

    Returns:
        The motion, and its first frame at rest.
    """
    time = np.arange(round((stop + EASE + hold) * fps) + 1) / fps
    late = np.clip(time - stop, 0, EASE)
    return _played(motion, fps, np.minimum(time, stop) + late - late**2 / (2 * EASE)), int(
        np.ceil((stop + EASE) * fps)
    )
