# SPDX-License-Identifier: Apache-2.0
"""Faces of bodies that are hidden: left out of a mesh, plainly or in a variant.

What readers honour was tried: Blender's importer and readers without OpenUSD draw faces in `holeIndices`, and those
of an invisible GeomSubset. Only faces that are not there are hidden everywhere. Points, weights and everything else
that is stored for points stay as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Sdf, Usd, UsdGeom, Vt

from ssilk_core.scene.assets import Ints, Mesh

from ..opening.stage import StageLike, open_stage

BODY, FULL, COVERED_HIDDEN = "body", "full", "covered_hidden"  # a variant set and its choices
FACES = ("faceVertexCounts", "faceVertexIndices")


@dataclass(frozen=True, eq=False)
class HiddenPolygons:
    """Which polygons of each body are hidden.

    Attributes:
        masks: for each body in order, shape (polygons,).
        variants: offer the whole bodies as a variant of the SkelRoot.
    """

    masks: tuple[NDArray[np.bool_], ...]
    variants: bool


def face_kind(prim: Usd.Prim, name: str) -> str | None:
    """Return whether an attribute of a mesh has rows for each "corner" or each "face" of it; None for neither."""
    base = name.removesuffix(":indices")
    primvar = UsdGeom.Primvar(prim.GetAttribute(base)) if base.startswith("primvars:") else None
    if not primvar or (primvar.IsIndexed() and name == base):
        return None
    kinds = {UsdGeom.Tokens.faceVarying: "corner", UsdGeom.Tokens.uniform: "face"}
    return kinds.get(primvar.GetInterpolation())


def author_faces(
    prim: UsdGeom.Mesh, mesh: Mesh, hidden: NDArray[np.bool_] | None = None, *, coordinates: bool = True
) -> None:
    """Author the polygons of a mesh that are not hidden, and their texture coordinates."""
    counts, indices = np.asarray(mesh.polygon_counts), mesh.indices_of_corners
    kept = np.ones(len(counts), dtype=bool) if hidden is None else ~hidden
    corners = np.repeat(kept, counts)
    prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.asarray(counts[kept], dtype=np.int32)))
    prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.asarray(indices[corners], dtype=np.int32)))
    if mesh.uvs is not None and coordinates:
        primvars = UsdGeom.PrimvarsAPI(prim)
        uvs = primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
        uvs.Set(Vt.Vec2fArray.FromNumpy(np.asarray(mesh.uvs[corners], dtype=np.float32)))


@dataclass(frozen=True, eq=False)
class _FaceRows:
    """Values of a mesh or its subsets that belong to its faces; `kind` is "corner", "face" or "subset"."""

    path: Sdf.Path
    kind: str
    values: Any

    def without(self, hidden: NDArray[np.bool_], counts: Ints) -> Any:
        """Return the values of the faces that stay."""
        array, kept = np.array(self.values), ~hidden
        if self.kind == "subset":
            found = (np.cumsum(kept) - 1)[array[kept[array]]] if len(array) else array
        else:
            rows = np.repeat(kept, counts) if self.kind == "corner" else kept
            found = array.reshape(len(rows), -1, *array.shape[1:])[rows].reshape(-1, *array.shape[1:])
        if not hasattr(self.values, "FromNumpy"):  # words
            return type(self.values)(found.tolist())
        return type(self.values).FromNumpy(np.ascontiguousarray(found.astype(array.dtype)))


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
    rows = {path: _face_rows(stage, path) for path, _, _ in bodies}
    if not hidden.variants:
        for path, mesh, mask in bodies:
            _leave_out(stage, path, mesh, mask, rows[path])
        return
    variants = stage.GetPrimAtPath(root).GetVariantSets().AddVariantSet(BODY)
    local = {path: _remove_faces(stage, path, rows[path]) for path, _, _ in bodies}
    for choice in (FULL, COVERED_HIDDEN):
        variants.AddVariant(choice)
        variants.SetVariantSelection(choice)
        for path, mesh, mask in bodies:
            with variants.GetVariantEditContext():
                if choice == COVERED_HIDDEN:
                    _leave_out(stage, path, mesh, mask, rows[path])
                elif local[path]:  # a variant is weaker than what stands beside it
                    prim = UsdGeom.Mesh(stage.OverridePrim(path))
                    author_faces(prim, mesh, coordinates=False)
                    for each in rows[path]:
                        stage.GetAttributeAtPath(each.path).Set(each.values)


def _face_rows(stage: Usd.Stage, path: Sdf.Path) -> list[_FaceRows]:
    """Return what a mesh and its subsets say of faces beside `FACES`."""
    prim = stage.GetPrimAtPath(path)
    found = [
        _FaceRows(attribute.GetPath(), kind, attribute.Get())
        for attribute in prim.GetAuthoredAttributes()
        if attribute.GetName() not in FACES and (kind := face_kind(prim, attribute.GetName())) is not None
    ]
    for subset in UsdGeom.Subset.GetAllGeomSubsets(UsdGeom.Imageable(prim)):
        if subset.GetElementTypeAttr().Get() == UsdGeom.Tokens.face:
            found.append(_FaceRows(subset.GetIndicesAttr().GetPath(), "subset", subset.GetIndicesAttr().Get()))
    return [each for each in found if each.values is not None]


def _leave_out(
    stage: Usd.Stage, path: Sdf.Path, mesh: Mesh, mask: NDArray[np.bool_], rows: Sequence[_FaceRows]
) -> None:
    prim = stage.OverridePrim(path)
    if mask.all():
        prim.SetActive(False)  # a mesh without faces is malformed to some readers
        return
    author_faces(UsdGeom.Mesh(prim), mesh, mask, coordinates=False)  # these are among the rows
    for each in rows:
        stage.GetAttributeAtPath(each.path).Set(each.without(mask, np.asarray(mesh.polygon_counts)))


def _remove_faces(stage: Usd.Stage, path: Sdf.Path, rows: Sequence[_FaceRows]) -> list[str]:
    """Remove what a layer itself holds of a mesh's faces; return which of `FACES` it held."""
    layer = stage.GetEditTarget().GetLayer()
    spec = layer.GetPrimAtPath(path)
    found = [name for name in FACES if spec and name in spec.properties]
    for name in found:
        spec.RemoveProperty(spec.properties[name])
    for each in rows:
        attribute = layer.GetAttributeAtPath(each.path)
        if attribute:
            attribute.ClearDefaultValue()
    return found


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
