# SPDX-License-Identifier: Apache-2.0
"""Write a repaired copy of a garment's file: its mesh with all data on it, and authored units."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pxr import Usd, UsdGeom

from ..opening.stage import explains_damage, open_stage, value
from ..reading.garment import find_garment, fitted_skeleton, garment_place
from ..units import StageUnits
from .export import export
from .repair_mesh import rewrite_mesh

if TYPE_CHECKING:
    from ssilk_core.authoring.preflight.repair import MeshRepair
    from ssilk_core.scene.assets import Skeleton

# What refers to points, edges or faces in ways that a repair would have to guess at.
_LOCKS = {
    "skel:blendShapeTargets": "blendshapes",
    "holeIndices": "holes",
    "creaseIndices": "creases",
    "cornerIndices": "sharp corners",
}


def repair_lock(source: str | Path, garment: str | None = None, root: str | None = None) -> str:
    """Return the reason why a garment's vertices and faces cannot be removed; empty if they can."""
    stage = open_stage(source)  # prims live only as long as their stage
    prim = find_garment(stage, garment, root)
    held = [words for name, words in _LOCKS.items() if _has(prim, name)]
    held += ["edge sets"] if any(_is_edge_set(child) for child in prim.GetChildren()) else []
    return " and ".join(held)


@explains_damage
def write_with_units(source: str | Path, out: str | Path, units: StageUnits) -> None:
    """Write a flattened copy of a file with authored units.

    Raises:
        SsilkError: the output cannot be written.
    """
    layer = open_stage(source).Flatten()
    stage = Usd.Stage.Open(layer)
    UsdGeom.SetStageMetersPerUnit(stage, units.meters_per_unit)
    UsdGeom.SetStageUpAxis(stage, units.up_axis)
    export(layer, out)


@explains_damage
def write_repaired(
    source: str | Path,
    out: str | Path,
    repair: MeshRepair,
    *,
    garment: str | None = None,
    root: str | None = None,
    skeleton: Skeleton | None = None,
) -> None:
    """Write a flattened copy of a garment's file with its mesh repaired.

    Every primvar, weight, class, normal and subset follows the vertices and faces that stay. Where merged vertices
    differ in a value, such as a texture coordinate, the value moves to the face corners and is kept.

    Args:
        source: the file with the garment.
        out: the file to write: .usdc, .usd or .usda.
        repair: relative to the mesh as `read_garment` returns it.
        garment, root: as in `read_garment`.
        skeleton: that the garment was read with; by default the one of its own stage.

    Raises:
        SsilkError: the output cannot be written, or a primvar does not match the mesh.
    """
    stage = open_stage(source)
    prim = find_garment(stage, garment, root)
    place = garment_place(prim, fitted_skeleton(prim, root), skeleton)
    stage.SetEditTarget(stage.GetSessionLayer())
    for prefix in prim.GetPath().GetPrefixes():  # what is instanced cannot be edited
        if stage.GetPrimAtPath(prefix).IsInstance():
            stage.GetPrimAtPath(prefix).SetInstanceable(False)
    path, layer = prim.GetPath(), stage.Flatten()
    copy = Usd.Stage.Open(layer)
    rewrite_mesh(UsdGeom.Mesh(copy.GetPrimAtPath(path)), repair, place.offsets_to_local(repair.offsets, repair.kept))
    export(layer, out)


def _has(prim: Usd.Prim, name: str) -> bool:
    if prim.HasRelationship(name):
        return bool(prim.GetRelationship(name).GetTargets())
    return len(value(prim, name) or ()) > 0


def _is_edge_set(prim: Usd.Prim) -> bool:
    kept = (UsdGeom.Tokens.face, UsdGeom.Tokens.point)
    return prim.IsA(UsdGeom.Subset) and UsdGeom.Subset(prim).GetElementTypeAttr().Get() not in kept
