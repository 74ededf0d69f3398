# SPDX-License-Identifier: Apache-2.0
"""A garment over a span of a motion without cuts, at the model's own rate, rolled as far as somebody looked."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..assets import GarmentPose, Motion
from .drive import Drive, drive

if TYPE_CHECKING:
    from .player import Player

HISTORY = 2  # frames before a block that its descriptors look back on


@dataclass(frozen=True, eq=False)
class Decoded:
    """What the decoder says of F frames: activations (K, F), and rotations (P, 3, 3, F) in bind-pose axes."""

    activations: NDArray
    rotations: NDArray


class Take:
    """Latents of a span, and what they decode to, in blocks that begin at fixed frames.

    A block is always computed whole and from the one before it, so that every bit is the same in whatever order
    frames are asked for.

    Args:
        player: what plays; motion: the span, at its rate; block: frames that are computed together.
    """

    def __init__(self, player: Player, motion: Motion, block: int) -> None:
        self.player, self.motion, self.block = player, motion, block
        self.latents = np.empty((motion.frame_count, player.file.config.latent), dtype=np.float32)
        self.rolled = 0
        self.driven = lru_cache(2)(self._driven)
        self.decoded = lru_cache(2)(self._decoded)

    def resume(self, before: Take, frames: int) -> None:
        """Take over the latents of the first `frames` frames, over which both motions are the same."""
        same = min(before.rolled, frames, before.motion.frame_count - 1)  # the last one may be held
        self.rolled = same // self.block * self.block
        self.latents[: self.rolled] = before.latents[: self.rolled]

    def states(self, stop: int) -> NDArray:
        """Return the latents of the frames up to `stop`, shape (stop, latent)."""
        while self.rolled < stop:
            self._roll()
        return self.latents[:stop]

    def stored(self, first: int, stop: int) -> GarmentPose:
        """Return what a file stores of frames `first` to `stop`."""
        blocks = [self.decoded(number) for number in range(first // self.block, -(-stop // self.block))]
        activations, rotations = (
            np.concatenate([getattr(each, name) for each in blocks], axis=-1) for name in ("activations", "rotations")
        )
        own = slice(first % self.block, first % self.block + stop - first)
        return GarmentPose(first, *self.player.decoder.stored(activations[:, own], rotations[..., own]))

    def _roll(self) -> None:
        done, player = self.rolled, self.player
        driven = self.driven(done // self.block)
        before = self.latents[done - 2 : done] if done else None
        course = player.stepper.prepared(player.at_rest(driven.static), driven.static, driven.rates, before)
        self.rolled = done + len(driven.static)
        self.latents[done : self.rolled] = player.stepper.rolled(course)

    def _driven(self, number: int) -> Drive:
        start = number * self.block
        seen = min(start, HISTORY)
        stop = min(start + self.block, self.motion.frame_count)
        return drive(self.motion.clip(start - seen, stop), self.player.skeleton, self.player.file.joints, seen)

    def _decoded(self, number: int) -> Decoded:
        start = number * self.block
        stop = min(start + self.block, self.motion.frame_count)
        return Decoded(*self.player.decoder.decoded(self.states(stop)[start:]))
