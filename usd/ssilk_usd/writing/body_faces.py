# SPDX-License-Identifier: Apache-2.0
"""Faces of bodies that are hidden: left out of a mesh, plainly or in a variant.

What readers honour was tried: Blender's importer and readers without OpenUSD draw faces in `holeIndices`, and those
of an invisible GeomSubset. Only faces that are not there are hidden everywhere. Points, weights and everything else
that is stored for points stay as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pxr import Sdf, Usd, UsdGeom, Vt

from ssilk_core.scene.assets import Mesh

from ..opening.stage import StageLike, open_stage

BODY, FULL, COVERED_HIDDEN = "body", "full", "covered_hidden"  # a variant set and its choices
FACES = ("faceVertexCounts", "faceVertexIndices", "primvars:st")


@dataclass(frozen=True, eq=False)
class HiddenPolygons:
    """Which polygons of each body are hidden.

    Attributes:
        masks: for each body in order, shape (polygons,).
        variants: offer the whole bodies as a variant of the SkelRoot.
    """

    masks: tuple[NDArray[np.bool_], ...]
    variants: bool


def author_faces(prim: UsdGeom.Mesh, mesh: Mesh, hidden: NDArray[np.bool_] | None = None) -> None:
    """Author the polygons of a mesh that are not hidden, and their texture coordinates."""
    counts, indices = np.asarray(mesh.polygon_counts), mesh.indices_of_corners
    kept = np.ones(len(counts), dtype=bool) if hidden is None else ~hidden
    corners = np.repeat(kept, counts)
    prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.asarray(counts[kept], dtype=np.int32)))
    prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.asarray(indices[corners], dtype=np.int32)))
    if mesh.uvs is not None:
        primvars = UsdGeom.PrimvarsAPI(prim)
        coordinates = primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
        coordinates.Set(Vt.Vec2fArray.FromNumpy(np.asarray(mesh.uvs[corners], dtype=np.float32)))


def hide_polygons(
    stage: Usd.Stage, root: Sdf.Path, paths: Sequence[Sdf.Path], meshes: Sequence[Mesh], hidden: HiddenPolygons
) -> None:
    """Hide polygons of bodies whose prims hold all of them: here, or in a layer that the stage references.

    Args:
        root: the SkelRoot; paths, meshes: the bodies, in the order of the masks.
    """
    bodies = [each for each in zip(paths, meshes, hidden.masks) if each[2].any()]
    if not bodies:
        return
    if not hidden.variants:
        for path, mesh, mask in bodies:
            _leave_out(stage, path, mesh, mask)
        return
    variants = stage.GetPrimAtPath(root).GetVariantSets().AddVariantSet(BODY)
    for choice in (FULL, COVERED_HIDDEN):
        variants.AddVariant(choice)
        variants.SetVariantSelection(choice)
        for path, mesh, mask in bodies:
            here = _remove_faces(stage, path) if choice == FULL else False
            with variants.GetVariantEditContext():
                if choice == COVERED_HIDDEN:
                    _leave_out(stage, path, mesh, mask)
                elif here:  # a variant is weaker than what stands beside it
                    author_faces(UsdGeom.Mesh(stage.OverridePrim(path)), mesh)


def _leave_out(stage: Usd.Stage, path: Sdf.Path, mesh: Mesh, mask: NDArray[np.bool_]) -> None:
    prim = stage.OverridePrim(path)
    if mask.all():
        prim.SetActive(False)  # a mesh without faces is malformed to some readers
    else:
        author_faces(UsdGeom.Mesh(prim), mesh, mask)


def _remove_faces(stage: Usd.Stage, path: Sdf.Path) -> bool:
    """Remove the faces that a layer itself holds of a mesh; return whether it held any."""
    spec = stage.GetEditTarget().GetLayer().GetPrimAtPath(path)
    found = [spec.properties[name] for name in FACES if spec and name in spec.properties]
    for each in found:
        spec.RemoveProperty(each)
    return bool(found)


def open_with_full_bodies(source: StageLike) -> Usd.Stage:
    """Open a stage with the whole bodies, where it offers them as a variant; the file stays as it is.

    Raises:
        SsilkError: not a readable stage.
    """
    stage = open_stage(source)
    chosen = [prim for prim in stage.Traverse() if FULL in prim.GetVariantSet(BODY).GetVariantNames()]
    with Usd.EditContext(stage, stage.GetSessionLayer()):
        for prim in chosen:
            prim.GetVariantSet(BODY).SetVariantSelection(FULL)
    return stage
