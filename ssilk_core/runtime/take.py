# SPDX-License-Identifier: Apache-2.0
"""A garment over a span of a motion without cuts, at the model's own rate, rolled as far as somebody looked."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..assets import GarmentPose, Motion
from ..kinematics import run_up
from .drive import CharacterFrames, drive

if TYPE_CHECKING:
    from .player import Player

HISTORY = 2  # frames before a block that its descriptors look back on


@dataclass(frozen=True, eq=False)
class Decoded:
    """What the decoder says of F frames: activations (K, F), and rotations (P, 3, 3, F) in bind-pose axes."""

    activations: NDArray
    rotations: NDArray


class RolledSpan:
    """Latents of a span, and what they decode to, in blocks that begin at fixed frames.

    A block is always computed whole and from the one before it, so that every bit is the same in whatever order
    frames are asked for. Frames before the span are block -1.

    Args:
        player: what plays.
        motion: the span, at the player's rate, after the frames before it.
        block: frames that are computed together.
        before: how many frames the garment runs up, at least two or none.
    """

    def __init__(self, player: Player, motion: Motion, block: int, before: int) -> None:
        self.player, self.motion, self.block, self.before = player, motion, block, before
        self.latents = np.empty((motion.frame_count, player.file.config.latent), dtype=np.float32)
        self.rolled = 0
        self.driven = lru_cache(2)(self._driven)
        self.decoded = lru_cache(2)(self._decoded)

    @property
    def frame_count(self) -> int:
        return self.motion.frame_count - self.before

    def resume(self, other: RolledSpan, frames: int) -> None:
        """Take over the latents of the span's first `frames` frames, over which both motions are the same."""
        same = min(other.rolled - other.before, frames, other.frame_count - 1)  # the last one may be held
        if same >= HISTORY:  # all that a run-up depends on
            self.rolled = self.before + same // self.block * self.block
            self.latents[: self.rolled] = other.latents[: self.rolled]

    def states(self, stop: int) -> NDArray:
        """Return the latents of the span's frames up to `stop`, shape (stop, latent)."""
        while self.rolled < self.before + stop:
            self._roll()
        return self.latents[self.before : self.before + stop]

    def stored(self, first: int, stop: int) -> GarmentPose:
        """Return what a file stores of the span's frames `first` to `stop`."""
        blocks = [self.decoded(number) for number in range(first // self.block, -(-stop // self.block))]
        activations, rotations = (
            np.concatenate([getattr(each, name) for each in blocks], axis=-1) for name in ("activations", "rotations")
        )
        own = slice(first % self.block, first % self.block + stop - first)
        return GarmentPose(first, *self.player.decoder.stored(activations[:, own], rotations[..., own]))

    def _frames(self, number: int) -> slice:
        """Return the frames of a block, counted from the first one before the span."""
        if number < 0:
            return slice(0, self.before)
        start = self.before + number * self.block
        return slice(start, min(start + self.block, self.motion.frame_count))

    def _roll(self) -> None:
        done, player = self.rolled, self.player
        driven = self.driven((done - self.before) // self.block)
        latents = player.at_rest(driven.static)
        if player.stepper:
            past = self.latents[done - 2 : done] if done else None
            latents = player.stepper.rolled(player.stepper.prepared(latents, driven.static, driven.rates, past))
        self.rolled = done + len(driven.static)
        self.latents[done : self.rolled] = latents

    def _driven(self, number: int) -> CharacterFrames:
        frames = self._frames(number)
        seen = min(frames.start, HISTORY)
        return drive(
            self.motion.clip(frames.start - seen, frames.stop), self.player.skeleton, self.player.file.joints, seen
        )

    def _decoded(self, number: int) -> Decoded:
        frames = self._frames(number)
        start, stop = frames.start - self.before, frames.stop - self.before
        return Decoded(*self.player.decoder.decoded(self.states(stop)[start:]))


def take_of(player: Player, span: Motion, block: int, pre_roll: float) -> RolledSpan:
    """Return the take of a span at the player's rate; with `pre_roll` [s] the garment runs up to its first frame."""
    if not pre_roll:
        return RolledSpan(player, span, block, 0)
    before = run_up(span, max(pre_roll, HISTORY / span.fps))
    rotations, translations = (
        np.concatenate([getattr(part, name) for part in (before, span)]) for name in ("rotations", "translations")
    )
    return RolledSpan(player, Motion(span.path, span.fps, rotations, translations), block, before.frame_count)
