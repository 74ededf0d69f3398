# SPDX-License-Identifier: Apache-2.0
"""Blocks of a rollout whose states are solved for, in place of those that `rollout.roll` yields."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import islice

import numpy as np
import torch

from ...scene.assets import Motion, Skeleton
from ...scene.fabrics import Fabric
from ...scene.kinematics import resample, run_up, split_at_cuts
from ..model.network import GarmentModel
from ..rollout import CHUNK, RolloutBlock
from .memory import LatentMemory
from .options import LatentOptions
from .shots import LatentFrame, LatentShots

FIGURES = "start_energy", "energy", "left_share", "step_left"  # of `LatentSolution`


@dataclass
class LatentTally:
    """What is known of the frames that were solved.

    Attributes:
        figures: `FIGURES` of the frames that were not lost, in the order of frames.
        frames: all that were solved.
        unconverged, failed: how many have not converged, and how many of them a line search stopped.
    """

    figures: dict[str, list[float]] = field(default_factory=lambda: {name: [] for name in FIGURES})
    frames: int = 0
    unconverged: int = 0
    failed: int = 0

    def add(self, frame: LatentFrame) -> None:
        """Add a frame of some shots."""
        found = frame.solution
        kept = (~frame.lost).nonzero()[:, 0]
        for name, values in self.figures.items():
            values.extend(getattr(found, name)[kept].tolist())
        self.frames += len(frame.lost)
        self.unconverged += int((~found.converged).sum())
        self.failed += int((found.failed & ~found.converged).sum())

    def mean(self, name: str) -> float:
        """Return the mean of a figure; zero without frames."""
        return float(np.mean(self.figures[name])) if self.figures[name] else 0.0


def frames_to_solve(motion: Motion, skeleton: Skeleton, fps: float, pre_roll: float) -> int:
    """Return how many frames a `LatentRoller` solves over a motion of any rate, for a model's rate."""
    spans = [resample(span, fps, cover=True) for span in split_at_cuts(motion, skeleton)]
    before = [run_up(span, pre_roll).frame_count if pre_roll else 0 for span in spans]
    return sum(span.frame_count for span in spans) + sum(before)


class LatentRoller:
    """Yields blocks as `rollout.roll` does, of states that minimise the simulator's energy over the latents.

    Args:
        model: on the device to use.
        fabric: of its garment.
        pre_roll: the garment starts at rest so many seconds before a span, in the pose of `run_up`.
        advanced: called after each frame that is solved.
        memory: keeps frames, for motions that begin alike; none by default.
        chunk: frames of a block.

    Attributes:
        tally: of all frames so far.
    """

    def __init__(
        self,
        model: GarmentModel,
        fabric: Fabric,
        options: LatentOptions,
        *,
        pre_roll: float = 0.0,
        advanced: Callable[[], object] = lambda: None,
        memory: LatentMemory | None = None,
        chunk: int = CHUNK,
    ) -> None:
        self.model, self.pre_roll, self.advanced = model, pre_roll, advanced
        self.memory, self.chunk = memory, chunk
        self.shots = LatentShots(model, fabric, options)
        self.tally = LatentTally()

    def __call__(self, span: Motion) -> Iterator[RolloutBlock]:
        """Yield the blocks of a motion without cuts, at the model's rate."""
        lead, played = 0, span
        if self.pre_roll:
            before = run_up(span, self.pre_roll)
            lead, played = before.frame_count, span.after(before)
        frames = self._solved(played)
        for _ in islice(frames, lead):
            pass
        for start in range(0, span.frame_count, self.chunk):
            yield self._block(start, list(islice(frames, self.chunk)))

    def _solved(self, motion: Motion) -> Iterator[LatentFrame]:
        if self.memory:
            frames = self.memory.frames(self.shots, motion)
        else:
            frames = ((frame, True) for frame in self.shots.frames([motion]))
        for frame, is_new in frames:
            self.tally.add(frame)
            if is_new:
                self.advanced()
            yield frame

    @torch.no_grad()
    def _block(self, start: int, frames: list[LatentFrame]) -> RolloutBlock:
        z = torch.cat([frame.solution.z for frame in frames]).to(next(self.model.parameters()).dtype)
        return RolloutBlock(start, *self.model.pose(z), torch.cat([frame.lost for frame in frames]))
