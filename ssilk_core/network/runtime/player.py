# SPDX-License-Identifier: Apache-2.0
"""A trained garment, ready to play motions."""

from __future__ import annotations

from pathlib import Path

from ...errors import fail
from ...scene.assets import Motion
from ..checkpoint import load_model
from .garment import NumpyGarment
from .playback import BLOCK, Playback


class Player(NumpyGarment):
    """A trained garment, ready to play motions."""

    @classmethod
    def load(cls, path: str | Path) -> Player:
        """Read a model file; raise `SsilkError` as `checkpoint.load_model` does."""
        return cls(load_model(path))

    def play(self, motion: Motion, *, pre_roll: float = 0.0, block: int = BLOCK) -> Playback:
        """Return the garment over a motion of any rate, with or without cuts; frames are computed on request.

        Args:
            motion: of the model's skeleton, at the shot's rate.
            pre_roll: time for which the garment settles before the first frame and after each cut [s].
            block: frames computed together; smaller blocks take more time per frame, but deliver the first one
                sooner.

        Raises:
            SsilkError: the motion belongs to another skeleton.
        """
        joints = self.skeleton.joint_count
        if motion.rotations.shape[1] != joints:
            fail(
                motion.path, f"a motion of {motion.rotations.shape[1]} joints", f"the model's character has {joints}"
            )
        return Playback(self, motion, block, pre_roll)
