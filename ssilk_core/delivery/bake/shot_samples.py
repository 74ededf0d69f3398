# SPDX-License-Identifier: Apache-2.0
"""The samples of a shot as frames of the motion that was read, and the motion that the network is rolled over."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...scene.assets import Motion, Skeleton
from ...scene.kinematics import held_at_cuts, sample_felt, sample_motion, slerp, split_at_cuts
from .looped import Loop


@dataclass(frozen=True, eq=False)
class ShotSamples:
    """Samples of a shot, counted from its first one; before it there may be some that are rolled out alone.

    Attributes:
        motion: the character's at these samples; `source` is the motion as it was read.
        lead: samples before the shot that are rolled out, at its rate.
        loop: how the shot repeats; None where it need not.
    """

    motion: Motion
    source: Motion
    skeleton: Skeleton
    lead: int = 0
    loop: Loop | None = None

    @property
    def rolled(self) -> int:
        """How many samples are rolled out: those before the shot and its own, or all rounds of a loop."""
        return self.loop.samples if self.loop else self.lead + self.motion.frame_count

    def seconds(self, sample: int) -> float:
        """Return the time of a sample, from the first frame of `source` on [s]."""
        return self.source_frame(sample) / self.source.fps

    def source_frame(self, sample: int) -> float:
        """Return the frame of `source` at a sample, a fraction where the grids differ."""
        frame = (self.motion.start + sample) * self.source.fps / self.motion.fps - self.source.start
        return float(round(frame)) if abs(frame - round(frame)) < 1e-6 else frame

    def driver(self, first: int, stop: int, step: int) -> Motion:
        """Return the motion that is rolled over, from one of the samples that are rolled on: at its own rate, or in
        steps of samples."""
        skeleton, source = self.skeleton, self.loop.motion if self.loop else self.source
        at = [self.source_frame(sample - self.lead) for sample in range(first, stop, step)]
        if step == 1:
            driver = from_fraction(source, skeleton, at[0])
            return driver if stop == self.rolled else driver.clip(0, int(at[-1] - at[0]) + 2)
        position = held_at_cuts(source, skeleton, np.array(at).clip(0, source.frame_count - 1))
        felt, poses = sample_felt(source, position), sample_motion(source, position)
        return Motion(source.path, self.motion.fps / step, *poses, **felt)


def step_before(motion: Motion) -> Motion:
    """Return the frame before a motion, from which it came as evenly as it goes on."""
    first, second = (motion.clip(frame, frame + 1) for frame in (0, min(1, motion.frame_count - 1)))
    turned = slerp(first.rotations, second.rotations, np.full((1, 1), -1.0))
    return replace(first, rotations=turned, translations=2 * first.translations - second.translations)


def from_fraction(motion: Motion, skeleton: Skeleton, first: float) -> Motion:
    """Return a motion with as many frames from a fractional one on, at its own rate.

    Nothing is interpolated across a cut: the frame before it becomes one of those after it, and their first step is
    continued back to it, as the last step of all is continued on.
    """
    whole = int(first)
    motion = motion.clip(whole, motion.frame_count)
    if first == whole:
        return motion
    frames = np.arange(motion.frame_count)
    ends = np.cumsum([span.frame_count for span in split_at_cuts(motion, skeleton)])
    own = np.searchsorted(ends, np.minimum(frames + 1, frames[-1]), side="right")
    begin, end = np.array([0, *ends[:-1]])[own], ends[own] - 1
    low = np.clip(frames, begin, np.maximum(end - 1, begin))
    high = np.minimum(low + 1, end)
    part = (frames + first - whole - low)[:, None]
    rotations = slerp(motion.rotations[low], motion.rotations[high], part)
    step = motion.translations[high] - motion.translations[low]
    translations = motion.translations[low] + part[..., None] * step
    felt = sample_felt(motion, np.clip(frames + first - whole, begin, end))
    return Motion(motion.path, motion.fps, rotations, translations, motion.start + first - whole, **felt)
