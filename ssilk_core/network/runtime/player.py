# SPDX-License-Identifier: Apache-2.0
"""A trained garment, ready to play motions."""

from __future__ import annotations

from pathlib import Path

from ...errors import fail
from ...scene.assets import Floats, Motion
from ..checkpoint import load_model
from .garment import NumpyGarment
from .playback import BLOCK, Playback


class Player(NumpyGarment):
    """A trained garment, ready to play motions."""

    @classmethod
    def load(cls, path: str | Path, coordinates: Floats | None = None) -> Player:
        """Read a model file.

        Args:
            coordinates: of the body that one of a family plays on, shape (K,) (`scene.family.BodyFamily`).

        Raises:
            SsilkError: as `checkpoint.load_model` does, or these are missing, not finite, or of another family.
        """
        file = load_model(path)
        return cls(file if coordinates is None else file.on_body(coordinates))

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
