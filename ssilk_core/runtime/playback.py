# SPDX-License-Identifier: Apache-2.0
"""A garment over one motion, any frame in any order."""

from __future__ import annotations

from bisect import bisect
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..assets import Floats, GarmentPose, Motion
from ..kinematics import resample, split_at_cuts
from ..sampling import sample_pose
from .drive import character_matrices
from .skinning import posed
from .take import Decoded, RolledSpan, take_of

if TYPE_CHECKING:
    from .player import Player

BLOCK = 64  # frames computed together: a product of matrices takes a third of the time of 64 with vectors
POSED = 16  # frames whose vertices are computed together


@dataclass(frozen=True, eq=False)
class Block:
    """Frames of a shot, F of them, from `first` on.

    Attributes:
        decoded: blendshape activations and proxy rotations.
        matrices: skinning matrices of all joints about the root, shape (J + P, 3, 4, F).
        origins: places of the root [m], shape (F, 3).
    """

    first: int
    decoded: Decoded
    matrices: NDArray
    origins: Floats


class Playback:
    """A garment over a motion. Every frame comes out alike in whatever order frames are asked for.

    Where the motion is cut, the garment starts anew; where it is not at the model's rate, poses are interpolated
    between the two nearest steps, as `rollout.garment_poses` does. A frame that is not there raises `IndexError`;
    negative ones count from the end.

    Args:
        player: what plays; motion: at the shot's rate; block: frames computed together.
        pre_roll: how long the garment settles before the first frame and after each cut [s].
    """

    def __init__(self, player: Player, motion: Motion, block: int, pre_roll: float) -> None:
        self.player, self.motion, self.block, self.pre_roll = player, motion, block, pre_roll
        self.rate = player.file.config.fps / motion.fps
        self.spans = split_at_cuts(motion)
        self.firsts = [int(first) for first in np.cumsum([0, *(span.frame_count for span in self.spans[:-1])])]
        fps = motion.fps if self._steps_with_frames else player.file.config.fps
        self.takes = [take_of(player, resample(span, fps, cover=True), block, pre_roll) for span in self.spans]
        # What was computed last; blocks begin at fixed frames, so that rounding does not depend on who asks.
        self._block = lru_cache(2)(self._blocked)
        self._vertices = lru_cache(2)(self._posed)

    @property
    def frame_count(self) -> int:
        return self.motion.frame_count

    @property
    def _steps_with_frames(self) -> bool:
        return abs(self.rate - 1) < 1e-9

    def changed(self, motion: Motion, frame: int) -> Playback:
        """Return the garment over a motion that is this one's before `frame`; what was rolled before it is kept."""
        other, mine = Playback(self.player, motion, self.block, self.pre_roll), dict(zip(self.firsts, self.takes))
        for first, take in zip(other.firsts, other.takes):
            if first in mine and first < frame:
                take.resume(mine[first], int((frame - 1 - first) * self.rate + 1e-6) + 1)
        return other

    def pose(self, frame: int) -> GarmentPose:
        """Return what a shot stores of one frame."""
        block, within = self._at(frame)
        activations, rotations = block.decoded.activations, block.decoded.rotations
        own = slice(within, within + 1)
        stored = self.player.decoder.stored(activations[:, own], rotations[..., own])
        return GarmentPose(block.first + within, *stored)

    def matrices(self, frame: int) -> tuple[NDArray, Floats]:
        """Return skinning matrices (J + P, 3, 4) of a frame about its root, and where the root is (3,) [m]."""
        block, within = self._at(frame)
        return block.matrices[..., within], block.origins[within]

    def vertices(self, frame: int) -> Floats:
        """Return the garment's vertices at a frame in world space [m], shape (V, 3)."""
        block, within = self._at(frame)
        return self._vertices(block.first, within // POSED)[within % POSED]

    def poses(self) -> Iterator[GarmentPose]:
        """Yield what a shot stores, some frames at a time."""
        for first, span in zip(self.firsts, self.spans):
            for start in range(first, first + span.frame_count, self.block):
                decoded = self._at(start)[0].decoded
                yield GarmentPose(start, *self.player.decoder.stored(decoded.activations, decoded.rotations))

    def _at(self, frame: int) -> tuple[Block, int]:
        """Return the block of a frame, and which one of it the frame is."""
        frame = range(self.frame_count)[frame]
        span = bisect(self.firsts, frame) - 1
        number, within = divmod(frame - self.firsts[span], self.block)
        return self._block(span, number), within

    def _blocked(self, span: int, number: int) -> Block:
        take, start = self.takes[span], number * self.block
        stop = min(start + self.block, self.spans[span].frame_count)
        if self._steps_with_frames:
            decoded, driven = take.decoded(number), take.driven(number)
            character, origins = driven.matrices, driven.origins
        else:
            decoded = self._interpolated(take, np.arange(start, stop) * self.rate)
            character, origins = character_matrices(self.spans[span].clip(start, stop), self.player.skeleton)
        matrices = self.player.kinematics.matrices(decoded.rotations, character)
        return Block(self.firsts[span] + start, decoded, matrices, origins)

    def _interpolated(self, take: RolledSpan, positions: Floats) -> Decoded:
        """Return what the decoder said between steps, at fractional ones."""
        positions = positions.clip(max=take.frame_count - 1)
        low, high = int(positions[0]), int(np.ceil(positions[-1]))
        pose = sample_pose(take.stored(low, high + 1), positions - low)
        return Decoded(*self.player.decoder.taken(pose))

    def _posed(self, first: int, part: int) -> Floats:
        """Return vertices (F, V, 3) of a few frames."""
        block, chosen = self._at(first)[0], slice(part * POSED, (part + 1) * POSED)
        activations = block.decoded.activations[:, chosen]
        return posed(self.player.tiles, activations, block.matrices[..., chosen], block.origins[chosen])
