# SPDX-License-Identifier: Apache-2.0
"""A garment over one motion, with random access to its frames."""

from __future__ import annotations

from bisect import bisect
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ...physics.loops import installed
from ...scene.assets import Floats, GarmentPose, Motion
from ...scene.kinematics import resample, split_at_cuts
from ..sampling import sample_pose
from .character import character_matrices
from .garment import NumpyGarment
from .skinning import skin_garment, vertex_block
from .span import DecodedFrames, RolledSpan, roll_span

BLOCK = 64  # frames computed together: a product of matrices takes a third of the time of 64 with vectors
COMPILED_FROM = 4096  # frames of a motion that gain more by compiled loops than it takes to load these, half a second


@dataclass(frozen=True, eq=False)
class Block:
    """F consecutive frames of a shot, from `first` on.

    Attributes:
        decoded: blendshape activations and proxy transforms.
        matrices: skinning matrices of all joints relative to the root, shape (J + P, 3, 4, F).
        origins: positions of the root [m], shape (F, 3).
    """

    first: int
    decoded: DecodedFrames
    matrices: NDArray
    origins: Floats


class Playback:
    """A garment over a motion. The order in which frames are requested does not change any result.

    After a cut in the motion the garment restarts. At another rate than the model's, poses are interpolated
    between the two nearest steps, as in `rollout.garment_poses`. Negative frames count from the end; frames out of
    range raise `IndexError`.

    Args:
        player: the trained garment; motion: at the shot's rate; block: frames computed together.
        pre_roll: time for which the garment settles before the first frame and after each cut [s].
    """

    def __init__(self, player: NumpyGarment, motion: Motion, block: int, pre_roll: float) -> None:
        self.player, self.motion, self.block, self.pre_roll = player, motion, block, pre_roll
        self.rate = player.file.config.fps / motion.fps
        self.vertex_block = vertex_block(player.file.scene.garment.mesh.vertex_count)
        self.spans = split_at_cuts(motion, player.skeleton)
        self.firsts = [int(first) for first in np.cumsum([0, *(span.frame_count for span in self.spans[:-1])])]
        fps = motion.fps if self._steps_with_frames else player.file.config.fps
        self.compiled = motion.frame_count >= COMPILED_FROM and installed()
        self.rolled_spans = [
            roll_span(player, resample(span, fps, cover=True), block, pre_roll, self.compiled) for span in self.spans
        ]
        # Blocks begin at fixed frames, so that rounding does not depend on which frames are requested.
        self._block = lru_cache(2)(self._compute_block)
        self._vertices = lru_cache(2)(self._compute_vertices)

    @property
    def frame_count(self) -> int:
        return self.motion.frame_count

    @property
    def _steps_with_frames(self) -> bool:
        return abs(self.rate - 1) < 1e-9

    def with_motion(self, motion: Motion, frame: int) -> Playback:
        """Return the garment over a motion that equals this one's before `frame`; latents up to there are kept."""
        other, mine = (
            Playback(self.player, motion, self.block, self.pre_roll),
            dict(zip(self.firsts, self.rolled_spans)),
        )
        for first, rolled in zip(other.firsts, other.rolled_spans):
            if first in mine and first < frame:
                rolled.resume(mine[first], int((frame - 1 - first) * self.rate + 1e-6) + 1)
        return other

    def pose(self, frame: int) -> GarmentPose:
        """Return the pose of one frame, as a shot stores it."""
        block, within = self._at(frame)
        activations, transforms = block.decoded.activations, block.decoded.transforms
        own = slice(within, within + 1)
        stored = self.player.decoder.file_pose(activations[:, own], transforms[..., own])
        return GarmentPose(block.first + within, *stored)

    def matrices(self, frame: int) -> tuple[NDArray, Floats]:
        """Return skinning matrices (J + P, 3, 4) relative to a frame's root, and the root's position (3,) [m]."""
        block, within = self._at(frame)
        return block.matrices[..., within], block.origins[within]

    def vertices(self, frame: int) -> Floats:
        """Return the garment's vertices at a frame in world space [m], shape (V, 3)."""
        block, within = self._at(frame)
        return self._vertices(block.first, within // self.vertex_block)[within % self.vertex_block]

    def poses(self) -> Iterator[GarmentPose]:
        """Yield the poses that a shot stores, one block at a time."""
        for first, span in zip(self.firsts, self.spans):
            for start in range(first, first + span.frame_count, self.block):
                decoded = self._at(start)[0].decoded
                yield GarmentPose(start, *self.player.decoder.file_pose(decoded.activations, decoded.transforms))

    def _at(self, frame: int) -> tuple[Block, int]:
        """Return the block that holds a frame, and the frame's index in it."""
        frame = range(self.frame_count)[frame]
        span = bisect(self.firsts, frame) - 1
        number, within = divmod(frame - self.firsts[span], self.block)
        return self._block(span, number), within

    def _compute_block(self, span: int, number: int) -> Block:
        rolled, start = self.rolled_spans[span], number * self.block
        stop = min(start + self.block, self.spans[span].frame_count)
        if self._steps_with_frames:
            decoded, frames = rolled.decoded(number), rolled.character(number)
            character, origins = frames.matrices, frames.origins
        else:
            decoded = self._interpolate(rolled, np.arange(start, stop) * self.rate)
            character, origins = character_matrices(self.spans[span].clip(start, stop), self.player.skeleton)
        matrices = self.player.kinematics.matrices(decoded.transforms, character)
        return Block(self.firsts[span] + start, decoded, matrices, origins)

    def _interpolate(self, rolled: RolledSpan, positions: Floats) -> DecodedFrames:
        """Return decoded values at fractional steps."""
        positions = positions.clip(max=rolled.frame_count - 1)
        low, high = int(positions[0]), int(np.ceil(positions[-1]))
        pose = sample_pose(rolled.file_pose(low, high + 1), positions - low)
        return DecodedFrames(*self.player.decoder.network_pose(pose))

    def _compute_vertices(self, first: int, part: int) -> Floats:
        """Return vertices (F, V, 3) of a few frames."""
        block, chosen = self._at(first)[0], slice(part * self.vertex_block, (part + 1) * self.vertex_block)
        activations = block.decoded.activations[:, chosen]
        given = activations, block.matrices[..., chosen], block.origins[chosen]
        return self.player.sparse_skin.skin(*given) if self.compiled else skin_garment(self.player.tiles, *given)
