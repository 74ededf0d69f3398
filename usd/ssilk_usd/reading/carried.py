# SPDX-License-Identifier: Apache-2.0
"""Meshes that one joint carries: they have no influences, and their xforms move as the joint does.

Meshes that are parented to a bone come out of other programs like this. To UsdSkel they are rigid props.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pxr import Usd, UsdSkel

from ssilk_core.scene.assets import Floats

from ..opening.stage import PRIMS, apply, column_matrix, value, world_matrix
from ..opening.times import change_times, xform_attributes
from .spaces import SkelSource

MOST_SAMPLES = 32  # of a motion that are looked at
STIFF = 1e-3  # how far points may move against the joint that carries them, as a share of the mesh's size


@dataclass(frozen=True, eq=False)
class CarriedMesh:
    """What carries a mesh.

    Attributes:
        joint: index into the joints of its `SkelSource`.
        to_bind: from the mesh's own space to bind space, where the joint is in its bind pose, shape (4, 4).
    """

    joint: int
    to_bind: Floats


def carried_by(prim: Usd.Prim, skel: SkelSource) -> CarriedMesh | None:
    """Return what carries a mesh without influences; None where it stands still or moves otherwise.

    Of several joints that do not move against the mesh, the first one of the skeleton is meant.
    """
    codes = _sampled_codes(prim)
    if len(codes) < 2:
        return None
    places, joints = _in_skeleton(prim, skel, codes), _joint_transforms(skel, codes)
    corners = _corners(prim)
    size = np.ptp(apply(places[0], corners), axis=0).max()
    if size <= 0 or _wander(places, corners).max() <= STIFF * size:
        return None
    own = skel.character_joints
    against = np.linalg.inv(joints[:, own]) @ places[:, None]
    still = np.flatnonzero(_wander(against, corners).max(axis=0) <= STIFF * size)
    if not len(still):
        return None
    joint = int(own[still[0]])
    return CarriedMesh(joint, skel.bind[joint] @ against[0, still[0]])


def _sampled_codes(prim: Usd.Prim) -> list[float]:
    """Return time codes at which the xforms of a prim and those above it change, some of them if many."""
    every = change_times(xform_attributes(prim))
    chosen = np.unique(np.linspace(0, len(every) - 1, min(len(every), MOST_SAMPLES)).round().astype(int))
    return [every[index] for index in chosen]


def _in_skeleton(prim: Usd.Prim, skel: SkelSource, codes: list[float]) -> Floats:
    """Return a prim's own space to skeleton space at each time code, shape (F, 4, 4)."""
    return np.stack([np.linalg.inv(world_matrix(skel.prim, code)) @ world_matrix(prim, code) for code in codes])


def _joint_transforms(skel: SkelSource, codes: list[float]) -> Floats:
    """Return joint to skeleton space at each time code, as the skeleton is animated, shape (F, N, 4, 4)."""
    cache = UsdSkel.Cache()
    cache.Populate(UsdSkel.Root(skel.root), PRIMS)
    query = cache.GetSkelQuery(UsdSkel.Skeleton(skel.prim))
    return skel.unscaled(np.stack([column_matrix(query.ComputeJointSkelTransforms(code)) for code in codes]))


def _corners(prim: Usd.Prim) -> Floats:
    """Return the corners of the box around a mesh's points in its own space, shape (8, 3)."""
    points = np.array(value(prim, "points") or [[0, 0, 0]], dtype=np.float64)
    low, high = points.min(axis=0), points.max(axis=0)
    return np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])


def _wander(transforms: Floats, points: Floats) -> Floats:
    """Return how far transforms (F, ..., 4, 4) move any of the points (N, 3) from the first frame, shape (F, ...)."""
    moved = np.einsum("...ij,nj->...ni", transforms[..., :3, :3], points) + transforms[..., None, :3, 3]
    return np.linalg.norm(moved - moved[:1], axis=-1).max(axis=-1)
