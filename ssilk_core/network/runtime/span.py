# SPDX-License-Identifier: Apache-2.0
"""A garment over a span of motion between two cuts, at the model's rate; latents are computed on request."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ...scene.assets import GarmentPose, Motion
from ...scene.kinematics import run_up
from .character import HISTORY, CharacterFrames, character_frames
from .garment import NumpyGarment


@dataclass(frozen=True, eq=False)
class DecodedFrames:
    """Output of the decoder for F frames: activations (K, F), and transforms (P, 3, 4, F) in bind-pose axes."""

    activations: NDArray
    transforms: NDArray


class RolledSpan:
    """Latents of a span between two cuts, and their decoded values, in blocks that begin at fixed frames.

    A block is always computed whole and from the block before it, so that results are the same bit for bit in
    whatever order frames are requested. Block -1 holds the pre-roll.

    Args:
        player: the trained garment.
        motion: the pre-roll, then the span, at the model's rate.
        block: frames that are computed together.
        before: number of pre-roll frames, zero or at least two.
        compiled: whether latents are rolled in compiled loops.
    """

    def __init__(self, player: NumpyGarment, motion: Motion, block: int, before: int, compiled: bool) -> None:
        self.player, self.motion, self.block, self.before = player, motion, block, before
        self.compiled = compiled
        self.latents = np.empty((motion.frame_count, player.file.config.latent), dtype=np.float32)
        sees = player.stepper is not None and player.stepper.points.size > 0
        size = len(player.decoder.layers[-1].bias) if sees else 0
        self.outputs = np.empty((motion.frame_count, size), dtype=np.float32)  # of D, where the stepper sees them
        self.rolled = 0
        self.character = lru_cache(2)(self._character)
        self.decoded = lru_cache(2)(self._decoded)

    @property
    def frame_count(self) -> int:
        return self.motion.frame_count - self.before

    def resume(self, other: RolledSpan, frames: int) -> None:
        """Copy the latents of the first `frames` frames, in which both motions are the same."""
        same = min(other.rolled - other.before, frames, other.frame_count - 1)  # the last one may be held
        if same >= HISTORY:  # the pre-roll depends on these
            self.rolled = self.before + same // self.block * self.block
            self.latents[: self.rolled] = other.latents[: self.rolled]
            self.outputs[: self.rolled] = other.outputs[: self.rolled]

    def states(self, stop: int) -> NDArray:
        """Return the latents of the span's frames up to `stop`, shape (stop, latent)."""
        while self.rolled < self.before + stop:
            self._roll()
        return self.latents[self.before : self.before + stop]

    def file_pose(self, first: int, stop: int) -> GarmentPose:
        """Return the span's frames `first` to `stop` as a file stores them."""
        blocks = [self.decoded(number) for number in range(first // self.block, -(-stop // self.block))]
        activations, transforms = (
            np.concatenate([getattr(each, name) for each in blocks], axis=-1)
            for name in ("activations", "transforms")
        )
        own = slice(first % self.block, first % self.block + stop - first)
        return GarmentPose(first, *self.player.decoder.file_pose(activations[:, own], transforms[..., own]))

    def _frames(self, number: int) -> slice:
        """Return the frames of a block, counted from the first frame of the pre-roll."""
        if number < 0:
            return slice(0, self.before)
        start = self.before + number * self.block
        return slice(start, min(start + self.block, self.motion.frame_count))

    def _roll(self) -> None:
        done, player = self.rolled, self.player
        character = self.character((done - self.before) // self.block)
        latents = player.quasi_static(character.static)
        if player.stepper:
            past = self.latents[done - 2 : done] if done else None
            inputs = player.stepper.prepare(latents, character, past)
            latents = player.stepper.roll(inputs, self.compiled)
            if inputs.outputs is not None:
                self.outputs[done : done + len(latents)] = inputs.outputs
        self.rolled = done + len(latents)
        self.latents[done : self.rolled] = latents

    def _character(self, number: int) -> CharacterFrames:
        frames = self._frames(number)
        lookback = min(frames.start, HISTORY)
        return character_frames(
            self.motion.clip(frames.start - lookback, frames.stop),
            self.player.skeleton,
            self.player.file.joints,
            lookback,
            self.player.file.config.descriptors,
            self.player.proximity,
        )

    def _decoded(self, number: int) -> DecodedFrames:
        frames = self._frames(number)
        states, decoder = self.states(frames.stop - self.before)[frames.start - self.before :], self.player.decoder
        if self.outputs.size:
            return DecodedFrames(*decoder.pose_of(self.outputs[frames].T))
        return DecodedFrames(*decoder.decode(states))


def roll_span(player: NumpyGarment, span: Motion, block: int, pre_roll: float, compiled: bool) -> RolledSpan:
    """Return a span at the model's rate, with `pre_roll` seconds in which the motion approaches its first frame."""
    if not pre_roll:
        return RolledSpan(player, span, block, 0, compiled)
    before = run_up(span, max(pre_roll, HISTORY / span.fps))
    return RolledSpan(player, span.after(before), block, before.frame_count, compiled)
