# SPDX-License-Identifier: Apache-2.0
"""Points of meshes at a time: deformed by UsdSkel's own functions, or by their samples."""

from __future__ import annotations

import numpy as np
from pxr import Usd, UsdGeom, UsdSkel

from ssilk_core.scene.assets import Floats

from ..opening.stage import EARLIEST, PRIMS, apply, column_matrix

Skinned = dict[Usd.Prim, tuple[Usd.Prim, UsdSkel.SkeletonQuery, UsdSkel.SkinningQuery]]


def skinning_of(stage: Usd.Stage) -> Skinned:
    """Return the Skeleton, its query and the skinning query of each skinned prim."""
    cache, found = UsdSkel.Cache(), {}
    for prim in Usd.PrimRange(stage.GetPseudoRoot(), PRIMS):
        root = UsdSkel.Root(prim)
        if not root:
            continue
        cache.Populate(root, PRIMS)
        for binding in cache.ComputeSkelBindings(root, PRIMS):
            skeleton = binding.GetSkeleton()
            for query in binding.GetSkinningTargets():
                found[query.GetPrim()] = (skeleton.GetPrim(), cache.GetSkelQuery(skeleton), query)
    return found


class SkinnedMesh:
    """A mesh that UsdSkel deforms: blendshapes in rest space, then linear blend skinning."""

    def __init__(
        self, prim: Usd.Prim, rig: Usd.Prim, skeleton: UsdSkel.SkeletonQuery, skinning: UsdSkel.SkinningQuery
    ) -> None:
        # The query's own prim may be that of a prototype, which stands at no place in the world.
        self.prim, self.rig, self.skeleton, self.skinning = prim, rig, skeleton, skinning
        self.rest = UsdGeom.Mesh(prim).GetPointsAttr()
        self.shapes = UsdSkel.BlendShapeQuery(UsdSkel.BindingAPI(prim)) if self._has_shapes() else None
        if self.shapes:
            self.rows = self.shapes.ComputeBlendShapePointIndices()
            self.offsets = self.shapes.ComputeSubShapePointOffsets()

    def _has_shapes(self) -> bool:
        return bool(self.skinning.HasBlendShapes() and self.skeleton.GetAnimQuery())

    def weights_attribute(self) -> Usd.Attribute | None:
        """Return what weighs the mesh's blendshapes; None where it has none, or nothing weighs them."""
        return (
            UsdSkel.Animation(self.skeleton.GetAnimQuery().GetPrim()).GetBlendShapeWeightsAttr()
            if self.shapes
            else None
        )

    def weights(self, time: Usd.TimeCode) -> Floats:
        """Return the weight of each of the mesh's own blendshapes, shape (K,)."""
        found = self.skeleton.GetAnimQuery().ComputeBlendShapeWeights(time)
        return np.array(self.skinning.GetBlendShapeMapper().Remap(found), dtype=np.float64)

    def reach(self) -> Floats:
        """Return how far each blendshape moves a point at most, weighing one, in the mesh's space, shape (K,)."""
        query = UsdSkel.BlendShapeQuery(UsdSkel.BindingAPI(self.prim))
        shapes = (query.GetBlendShape(index) for index in range(query.GetNumBlendShapes()))
        offsets = (np.array(shape.GetOffsetsAttr().Get() or [], dtype=np.float64).reshape(-1, 3) for shape in shapes)
        return np.array([np.linalg.norm(each, axis=1).max(initial=0) for each in offsets])

    def points(self, time: Usd.TimeCode, xforms: UsdGeom.XformCache) -> Floats:
        """Return the posed points in stage units, shape (V, 3)."""
        joints = self.skinning.HasJointInfluences()
        # UsdSkel begins with the earliest points, whatever later ones are, but deforms no cache.
        points = self.rest.Get(EARLIEST if joints or self.shapes else time)
        if self.shapes:
            weights = self.skeleton.GetAnimQuery().ComputeBlendShapeWeights(time)
            own = self.skinning.GetBlendShapeMapper().Remap(weights)
            self.shapes.ComputeDeformedPoints(
                *self.shapes.ComputeSubShapeWeights(own), self.rows, self.offsets, points
            )
        space = self.prim
        if joints:
            self.skinning.ComputeSkinnedPoints(self.skeleton.ComputeSkinningTransforms(time), points, time)
            space = self.rig
        return apply(column_matrix(xforms.GetLocalToWorldTransform(space)), np.array(points, dtype=np.float64))


class PlainMesh:
    """A mesh with stored points, static or time-sampled."""

    def __init__(self, prim: Usd.Prim) -> None:
        self.prim, self.samples = prim, UsdGeom.Mesh(prim).GetPointsAttr()

    def points(self, time: Usd.TimeCode, xforms: UsdGeom.XformCache) -> Floats:
        """Return the points in stage units, shape (V, 3)."""
        points = np.array(self.samples.Get(time), dtype=np.float64)
        return apply(column_matrix(xforms.GetLocalToWorldTransform(self.prim)), points)


def posed_mesh(prim: Usd.Prim, skinned: Skinned) -> SkinnedMesh | PlainMesh:
    """Return what gives the points of a mesh, as its stage's `skinning_of` says."""
    return SkinnedMesh(prim, *skinned[prim]) if prim in skinned else PlainMesh(prim)
