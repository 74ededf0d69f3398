# SPDX-License-Identifier: Apache-2.0
"""A garment as bones and blendshapes: what a shot holds and a host deforms. Without `pxr`."""

from __future__ import annotations

from dataclasses import dataclass

from ssilk_core.scene.assets import Deformer, Floats, GarmentPose, SkinWeights

from ..names import shape_name


@dataclass(frozen=True, eq=False)
class SkinnedGarment:
    """A garment as UsdSkel deforms it: rest points, blendshapes, joints and weights.

    Attributes:
        joint_names: UsdSkel joint paths, the character's first, then the proxies, length J.
        bind_transforms: joint to world at the bind pose, rigid [m], shape (J, 4, 4).
        points: at rest [m], shape (V, 3).
        skin: weights over all joints.
        shape_names: of the blendshapes, length K.
        shapes: their offsets [m], shape (K, V, 3).
    """

    joint_names: tuple[str, ...]
    bind_transforms: Floats
    points: Floats
    skin: SkinWeights
    shape_names: tuple[str, ...]
    shapes: Floats

    @classmethod
    def of(cls, deformer: Deformer) -> SkinnedGarment:
        """Return a trained garment with all blendshapes, including those without effect, which a shot omits."""
        scene = deformer.scene
        names = tuple(map(shape_name, range(deformer.shape_count)))
        points = scene.garment.mesh.points
        return cls(scene.joint_names, scene.bind_transforms, points, deformer.skin, names, deformer.shapes)


@dataclass(frozen=True, eq=False)
class BakedGarment:
    """A baked garment with all its frames; `start` is the time code of the first one."""

    garment: SkinnedGarment
    pose: GarmentPose
    start: float
