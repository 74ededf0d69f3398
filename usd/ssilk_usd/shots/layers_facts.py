# SPDX-License-Identifier: Apache-2.0
"""Facts of an asset on which layers above may rely: joints, topology and blendshapes."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pxr import Usd, UsdGeom, UsdSkel

from ..opening.stage import PRIMS, open_stage


@dataclass(frozen=True)
class MeshFacts:
    """`points` and `faces` are counts; `topology` is a hash of the faces."""

    points: int
    faces: int
    topology: str
    shapes: tuple[str, ...]


@dataclass(frozen=True)
class AssetFacts:
    """Joints of the Skeleton and facts of each mesh by its path."""

    joints: tuple[str, ...]
    meshes: dict[str, MeshFacts]

    def changes_since(self, before: AssetFacts) -> tuple[str, ...]:
        """Return what changed, as sentences without an end."""
        changes = []
        if self.joints != before.joints:
            changes.append(f"the skeleton had {len(before.joints)} joints and has {len(self.joints)}, or others")
        for path in sorted(before.meshes.keys() | self.meshes.keys()):
            changes += _mesh_changes(path, before.meshes.get(path), self.meshes.get(path))
        return tuple(changes)


def _mesh_changes(path: str, before: MeshFacts | None, now: MeshFacts | None) -> list[str]:
    if before is None or now is None:
        return [f"{path} {'is new' if before is None else 'is gone'}"]
    changes = []
    if (before.points, before.topology) != (now.points, now.topology):
        changes.append(
            f"the topology of {path} changed ({before.points} points and {before.faces} faces, "
            f"now {now.points} and {now.faces})"
        )
    if before.shapes != now.shapes:
        changes.append(f"{path} had {len(before.shapes)} blendshapes and has {len(now.shapes)}, or others")
    return changes


def asset_facts(path: Path) -> AssetFacts:
    """Return the facts of a written asset.

    Raises:
        SsilkError: it cannot be read.
    """
    stage = open_stage(path)
    prims = list(Usd.PrimRange(stage.GetPseudoRoot(), PRIMS))
    skeletons = [UsdSkel.Skeleton(prim) for prim in prims if prim.IsA(UsdSkel.Skeleton)]
    joints = tuple(joint for skeleton in skeletons for joint in skeleton.GetJointsAttr().Get() or ())
    return AssetFacts(joints, {str(prim.GetPath()): _mesh_facts(prim) for prim in prims if prim.IsA(UsdGeom.Mesh)})


def _mesh_facts(prim: Usd.Prim) -> MeshFacts:
    mesh, binding = UsdGeom.Mesh(prim), UsdSkel.BindingAPI(prim)
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get() or [])
    indices = np.array(mesh.GetFaceVertexIndicesAttr().Get() or [])
    topology = hashlib.sha256(counts.tobytes() + indices.tobytes()).hexdigest()
    points = len(mesh.GetPointsAttr().Get() or [])
    return MeshFacts(points, len(counts), topology, tuple(binding.GetBlendShapesAttr().Get() or ()))
