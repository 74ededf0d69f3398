# SPDX-License-Identifier: GPL-3.0-or-later
"""A trained model, and which joints of it the bones of an armature are."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ssilk_core.errors import SsilkError
from ssilk_core.network.runtime import Player

from ..errors import SetupError
from ..joints import Joints, joint_order
from ..outside.wording import recall, reworded


class TrainedGarment:
    """A model on an armature.

    Attributes:
        player: plays it.
        own: joints of the armature in the order of the model's character, shape (J,).
        order: joints of the model in the order of the armature, proxies included, shape (J + P,).

    Raises:
        SsilkError: it cannot be read, or has other joints than the armature.
    """

    def __init__(self, path: Path, joints: Joints) -> None:
        try:
            self.player = Player.load(path)
        except SsilkError as error:
            raise SetupError(reworded(str(error), path.parent, recall(path.parent))) from error
        self.joints = joints
        self.order = joint_order(joints, self.player.file.scene.joint_names)
        self.own = np.argsort(self.order[: joints.character_count])

    @property
    def proxies(self) -> np.ndarray:
        """Proxies of the model in the order of the armature, counted from the first one, shape (P,)."""
        return self.order[self.joints.character_count :] - self.joints.character_count
