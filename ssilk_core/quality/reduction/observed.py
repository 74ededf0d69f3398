# SPDX-License-Identifier: Apache-2.0
"""Frames of motions on which the error of a smaller model is measured."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...errors import fail
from ...network.runtime import Player
from ...network.runtime.character import character_matrices
from ...network.runtime.skinning import skin_garment
from ...scene.assets import Floats, Motion, Skeleton

FRAMES_PER_BLOCK = 16  # frames whose vertices are in memory at once


@dataclass(frozen=True, eq=False)
class ObservedFrames:
    """F frames of motions, shared by all models reduced from one.

    Attributes:
        states: latents, shape (F, latent).
        character: skinning matrices of the character's joints relative to the root, shape (J, 3, 4, F).
    """

    states: NDArray
    character: NDArray

    def decode(self, player: Player) -> tuple[NDArray, NDArray]:
        """Return a model's activations (K, F) and skinning matrices of all its joints (J + P, 3, 4, F)."""
        activations, transforms = player.decoder.decode(self.states)
        return activations, player.kinematics.matrices(transforms, self.character)

    def vertices(self, player: Player) -> Iterator[Floats]:
        """Yield a model's vertices relative to the root [m], one block of frames at a time, shape (F', V, 3)."""
        activations, matrices = self.decode(player)
        for start in range(0, len(self.states), FRAMES_PER_BLOCK):
            chosen = slice(start, start + FRAMES_PER_BLOCK)
            count = len(self.states[chosen])
            yield skin_garment(player.tiles, activations[:, chosen], matrices[..., chosen], np.zeros((count, 3)))


def observe(player: Player, motions: Sequence[Motion], frames: int) -> ObservedFrames:
    """Play motions and return about `frames` frames of them, evenly spread.

    Raises:
        SsilkError: there is no motion, or it belongs to another character.
    """
    if not motions:
        fail("motions", "none given", "at least one is needed", "name motion files with --motions")
    spans = [span for motion in motions for span in player.play(motion).rolled_spans]
    every = max(1, sum(span.motion.frame_count for span in spans) // frames)
    return ObservedFrames(
        np.concatenate([span.states(span.motion.frame_count)[::every] for span in spans]),
        np.concatenate([_character(span.motion, every, player.skeleton) for span in spans], axis=-1),
    )


def _character(motion: Motion, every: int, skeleton: Skeleton) -> NDArray:
    """Return the character's skinning matrices relative to its root (J, 3, 4, F) for every `every`th frame."""
    return character_matrices(motion.picked(slice(None, None, every)), skeleton)[0]
