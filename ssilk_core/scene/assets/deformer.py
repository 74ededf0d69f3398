# SPDX-License-Identifier: Apache-2.0
"""A trained garment in the form that UsdSkel defines, and its poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...errors import fail
from .arrays import Floats, assign, frozen
from .scene import Scene
from .skin import SkinWeights


@dataclass(frozen=True, eq=False)
class Deformer:
    """A trained garment as UsdSkel defines it: rest points, blendshapes and skinning weights (Eqs. 5 and 8).

    Attributes:
        scene: the garment, its character and its rig.
        skin: trained weights over the combined joints.
        shapes: blendshape offsets in rest space [m], shape (K, V, 3); zero rows for pinned vertices.
    """

    scene: Scene
    skin: SkinWeights
    shapes: Floats

    def __post_init__(self) -> None:
        assign(self, shapes=frozen(self.shapes, np.float32))
        count = self.scene.garment.mesh.vertex_count
        if not (self.shapes.ndim == 3 and self.shapes.shape[1:] == (count, 3)):
            fail(
                self.scene.garment.mesh.path,
                f"blendshapes of shape {self.shapes.shape}",
                f"(shapes, {count}, 3) is needed",
            )
        self.skin.check_joints(len(self.scene.joint_names))

    @property
    def shape_count(self) -> int:
        return len(self.shapes)


@dataclass(frozen=True, eq=False)
class GarmentPose:
    """Poses of a garment in consecutive frames, as the network predicts and a shot stores them (Eq. 7).

    The network turns its proxies; those of a shot that was fitted to vertices move as well.

    Attributes:
        start: index of the first frame within the shot.
        rotations: local rotations of the proxies, (w, x, y, z), relative to their parents, shape (F, P, 4).
        weights: blendshape weights in [0, 1], shape (F, K).
        translations: local translations of the proxies [m], shape (F, P, 3); None for those of the bind pose.
    """

    start: int
    rotations: Floats
    weights: Floats
    translations: Floats | None = None

    def __post_init__(self) -> None:
        assign(self, rotations=frozen(self.rotations, np.float64), weights=frozen(self.weights, np.float32))
        if self.translations is not None:
            assign(self, translations=frozen(self.translations, np.float64))

    @property
    def frame_count(self) -> int:
        return len(self.weights)

    def part(self, frames: slice) -> GarmentPose:
        """Return consecutive frames of these, counted from the first; all if there are fewer."""
        first = frames.indices(self.frame_count)[0]
        moved = None if self.translations is None else self.translations[frames]
        return GarmentPose(self.start + first, self.rotations[frames], self.weights[frames], moved)

    @classmethod
    def joined(cls, poses: Sequence[GarmentPose]) -> GarmentPose:
        """Return consecutive poses as one.

        Raises:
            ValueError: some of them have translations, and others have none.
        """
        moved = [pose.translations for pose in poses if pose.translations is not None]
        if len(moved) not in (0, len(poses)):
            raise ValueError("some poses have translations of the proxies, and others have none")
        return cls(
            poses[0].start,
            np.concatenate([pose.rotations for pose in poses]),
            np.concatenate([pose.weights for pose in poses]),
            np.concatenate(moved) if moved else None,
        )
