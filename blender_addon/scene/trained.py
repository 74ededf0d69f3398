# SPDX-License-Identifier: GPL-3.0-or-later
"""A trained model as Blender sees it: its bones by the armature's, its shapes and weights in Blender's world."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..contract.arrays import Joints, Shot
from ..contract.axes import from_core, points_from_core
from ..contract.names import joint_paths
from ..core import core
from ..errors import SetupError, need


class Trained:
    """A model, and which joint of it each one of an armature is.

    Attributes:
        player: plays it (`ssilk_core.runtime.Player`).
        own: joints of the armature in the order of the model's character, shape (J,).
        order: joints of the model in the order of the armature, proxies included, shape (J + P,).

    Raises:
        SetupError: it cannot be read, or has other joints than the armature.
    """

    def __init__(self, path: Path, joints: Joints, meters_per_unit: float) -> None:
        try:
            self.player = core("runtime").Player.load(path)
        except core("errors").SsilkError as error:
            raise SetupError(str(error)) from error
        self.joints, self.meters = joints, meters_per_unit
        names = joint_paths(joints.names, joints.parents)
        wanted = self.player.file.scene.joint_names
        odd = sorted(set(names) ^ set(wanted))
        need(
            not odd,
            f"The bones are not those that the model was trained with ('{odd[0].rpartition('/')[2] if odd else ''}' "
            "was added, removed, renamed or has another parent); undo that, or train again.",
        )
        self.own = np.array([names.index(name) for name in self.player.skeleton.joint_names])
        self.order = np.array([wanted.index(name) for name in names])

    @property
    def proxies(self) -> np.ndarray:
        """Proxies of the model in the order of the armature, counted from the first one, shape (P,)."""
        return self.order[self.joints.character_count :] - self.joints.character_count

    def shot(self) -> Shot:
        """Return the garment as a shot without frames, in the joint order of the armature."""
        deformer = self.player.deformer()
        scene, count = deformer.scene, len(deformer.shapes)
        return Shot(
            start=0,
            binds=from_core(scene.bind_transforms, self.meters)[self.order],
            rotations=np.zeros((0, self.joints.proxy_count, 4)),
            points=points_from_core(scene.garment.mesh.points, self.meters),
            weights=deformer.skin.dense(len(self.order))[:, self.order].astype(np.float32),
            shapes=tuple(f"shape_{shape:03d}" for shape in range(count)),
            offsets=points_from_core(deformer.shapes, self.meters),
            activations=np.zeros((0, count)),
        )
