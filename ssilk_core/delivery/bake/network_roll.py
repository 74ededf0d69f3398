# SPDX-License-Identifier: Apache-2.0
"""The network rolled over the samples of a shot, as an animator directs the garment."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING

from ...scene.assets import Deformer, GarmentPose
from .direction import CHUNK, DirectedPoses, Direction
from .result import FrameSpan
from .shot_samples import ShotSamples

if TYPE_CHECKING:
    from ...network.latent_solver import LatentRoller
    from ...network.model.network import GarmentModel
    from ...network.start import GivenStart


@dataclass(frozen=True, eq=False)
class NetworkRoll:
    """A trained garment's poses over a shot.

    Attributes:
        deformer: the garment with the network's blendshapes alone.
        pre_roll: run-up to the first pose and after each cut [s].
        given: the state that the first frame begins with; None to begin at rest.
        direction: where the garment is held; None where it moves freely throughout.
        held_off: RMS distance from linear blend skinning of frames that are held [m]; filled while `poses` yields.
    """

    model: GarmentModel
    deformer: Deformer
    samples: ShotSamples
    pre_roll: float = 0.0
    given: GivenStart | None = None
    direction: Direction | None = None
    held_off: list[float] = field(default_factory=list)

    def poses(
        self, start: int, stop: int, roller: LatentRoller | None, lost: list[FrameSpan]
    ) -> Iterator[GarmentPose]:
        """Yield the poses of samples that are rolled, counted from `start`, and list where the rollout was lost.

        Args:
            roller: solves for states in latents; None for those of the network.
        """
        rolled = partial(self._rolled, roller=roller, lost=lost, start=start)
        if self.direction is not None:
            directed = DirectedPoses(self.direction, self.deformer, rolled)
            for pose in directed.poses(start, stop):
                self.held_off[:] = directed.off  # now: a loop may ask for no more
                yield pose
            return
        for pose in rolled(0, stop, 1):
            part = pose.part(slice(max(start - pose.start, 0), None))
            if part.frame_count:
                yield replace(part, start=part.start - start)

    def _rolled(
        self, first: int, stop: int, step: int, roller: LatentRoller | None, lost: list[FrameSpan], start: int
    ) -> Iterator[GarmentPose]:
        """Yield the network's poses at samples first, first + step, ..., below stop; it starts at first.

        In between the motion is seen as straight. Where the rollout is lost is listed, counted from `start`.
        """
        from ...network.rollout import garment_poses

        count, given = len(range(first, stop, step)), self.given if first == 0 else None

        def note(frames: range) -> None:
            begin, end = first + frames[0] * step, min(first + (frames[-1] + 1) * step, stop) - 1
            if end >= start:
                lost.append(FrameSpan(max(begin - start, 0), end - start))

        driver, rate = self.samples.driver(first, stop, step), self.samples.motion.fps / step
        for pose in garment_poses(
            self.model, driver, rate, CHUNK, note, pre_roll=self.pre_roll, roller=roller, given=given
        ):
            part = pose.part(slice(0, max(count - pose.start, 0)))
            if part.frame_count:
                yield part
