# SPDX-License-Identifier: Apache-2.0
"""Rewriting a mesh after its points and faces were merged, removed or turned over, with all data on them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from pxr import Usd, UsdGeom

from ssilk_core.errors import fail
from ssilk_core.scene.assets import Floats, Ints

from ..opening.stage import EARLIEST, location, value
from ..reading.mesh import winds_backwards

if TYPE_CHECKING:
    from ssilk_core.authoring.preflight.repair import MeshRepair

# Skinning and the tool's own data stay on points; vertices only merge where these agree.
_ON_POINTS = ("skel:", "ssilk:")
NORMALS = ("normals", "primvars:normals", "primvars:normals:indices")
_VERTEX = (UsdGeom.Tokens.vertex, UsdGeom.Tokens.varying)
Change = Callable[[np.ndarray], np.ndarray]


def rewrite_mesh(mesh: UsdGeom.Mesh, repair: MeshRepair, offsets: Floats) -> None:
    """Rewrite a mesh in place.

    Args:
        repair: relative to the mesh as `read_mesh` returns it; the mesh has no holes where it reshapes.
        offsets: how far the kept points move, in the mesh's own space and units, shape (V', 3).

    Raises:
        SsilkError: a primvar does not match the mesh.
    """
    if repair.reshapes:
        _reshape(mesh, repair)
    offset_points(mesh, offsets)


def offset_points(mesh: UsdGeom.Mesh, offsets: Floats) -> None:
    """Move the points of a mesh by offsets in its own space and units, shape (V, 3), and its extent with them.

    Authored normals would be those of another shape. They are blocked, so that readers compute their own.
    """
    for attribute in map(mesh.GetPrim().GetAttribute, NORMALS if offsets.any() else ()):
        if attribute.HasAuthoredValue():
            attribute.Block()
    _change(mesh.GetPointsAttr(), lambda rows: (rows + offsets).astype(rows.dtype))
    if mesh.GetExtentAttr().HasAuthoredValue():
        extent = np.array(UsdGeom.PointBased.ComputeExtent(mesh.GetPointsAttr().Get(EARLIEST)))
        _change(mesh.GetExtentAttr(), lambda _: extent)


def _reshape(mesh: UsdGeom.Mesh, repair: MeshRepair) -> None:
    """Remove points and faces, flip faces, and update all data on them."""
    corners = _authored_corners(mesh, repair)
    old = np.array(value(mesh.GetPrim(), "faceVertexIndices"), dtype=np.int64)
    for primvar in UsdGeom.PrimvarsAPI(mesh.GetPrim()).GetPrimvarsWithAuthoredValues():
        _rewrite_primvar(primvar, repair, old, corners)
    _rewrite_normals(mesh, repair, old, corners)
    for attribute in (mesh.GetVelocitiesAttr(), mesh.GetAccelerationsAttr(), mesh.GetPointsAttr()):
        _change(attribute, partial(_taken, rows=repair.kept))
    _rewrite_subsets(mesh.GetPrim(), repair)
    _change(mesh.GetFaceVertexCountsAttr(), lambda _: repair.counts)
    _change(mesh.GetFaceVertexIndicesAttr(), lambda _: repair.new_index[old[corners]])


def _authored_corners(mesh: UsdGeom.Mesh, repair: MeshRepair) -> Ints:
    """Return the authored corners of the new faces; `read_mesh` reverses those that run clockwise."""
    if not winds_backwards(mesh.GetPrim()):
        return repair.corners
    counts = np.array(value(mesh.GetPrim(), "faceVertexCounts"), dtype=np.int64)
    return _backwards(counts)[repair.corners][_backwards(repair.counts)]


def _backwards(counts: Ints) -> Ints:
    """Return the order of corners that reverses every face, shape (sum of counts,)."""
    first, last = np.cumsum(counts) - counts, np.cumsum(counts) - 1
    return np.repeat(first + last, counts) - np.arange(counts.sum())


def _rewrite_primvar(primvar: UsdGeom.Primvar, repair: MeshRepair, old: Ints, corners: Ints) -> None:
    """Update a primvar: the indices of an indexed one, else its values."""
    indexed, interpolation = primvar.IsIndexed(), primvar.GetInterpolation()
    attribute = primvar.GetIndicesAttr() if indexed else primvar.GetAttr()
    size = 1 if indexed else primvar.GetElementSize()
    _check_length(attribute, size, interpolation, repair, old)
    bound = primvar.GetPrimvarName().startswith(_ON_POINTS)
    split = interpolation in _VERTEX and not bound and _torn(attribute, size, repair)
    rows = _rows_of(interpolation, split, repair, old, corners)
    if rows is not None:
        _change(attribute, partial(_taken, rows=rows, size=size))
    if split:
        primvar.SetInterpolation(UsdGeom.Tokens.faceVarying)


def _rewrite_normals(mesh: UsdGeom.Mesh, repair: MeshRepair, old: Ints, corners: Ints) -> None:
    """Update authored normals, and negate those of flipped faces."""
    attribute, interpolation = mesh.GetNormalsAttr(), mesh.GetNormalsInterpolation()
    if not attribute.HasAuthoredValue():
        return
    _check_length(attribute, 1, interpolation, repair, old)
    split = interpolation in _VERTEX and _torn(attribute, 1, repair)
    rows = _rows_of(interpolation, split, repair, old, corners)
    if rows is None:
        return
    if split:
        interpolation = UsdGeom.Tokens.faceVarying
        mesh.SetNormalsInterpolation(interpolation)
    sign = np.where(_turned(interpolation, repair, old[corners]), -1.0, 1.0)[:, None]
    _change(attribute, lambda values: (values[rows] * sign).astype(values.dtype))


def _turned(interpolation: str, repair: MeshRepair, vertices: Ints) -> np.ndarray:
    """Return which new rows of an interpolation belong to flipped faces."""
    if interpolation == UsdGeom.Tokens.uniform:
        return repair.flipped
    on_corners = np.repeat(repair.flipped, repair.counts)
    if interpolation == UsdGeom.Tokens.faceVarying:
        return on_corners
    return np.isin(repair.kept, repair.kept[repair.new_index[vertices[on_corners]]])


def _rows_of(interpolation: str, split: bool, repair: MeshRepair, old: Ints, corners: Ints) -> Ints | None:
    """Return the old row of each new row; None for constant interpolation."""
    if split:
        return old[corners]
    if interpolation in _VERTEX:
        return repair.kept
    return {UsdGeom.Tokens.uniform: repair.polygons, UsdGeom.Tokens.faceVarying: corners}.get(interpolation)


def _check_length(attribute: Usd.Attribute, size: int, interpolation: str, repair: MeshRepair, old: Ints) -> None:
    if interpolation == UsdGeom.Tokens.constant:
        return
    faces = len(value(attribute.GetPrim(), "faceVertexCounts"))
    rows = {UsdGeom.Tokens.uniform: faces, UsdGeom.Tokens.faceVarying: len(old)}
    expected = rows.get(interpolation, len(repair.new_index))
    for time in _times(attribute):
        found = len(attribute.Get(time))
        if found != expected * size:
            fail(
                location(attribute.GetPrim()),
                f"{attribute.GetName()} holds {found} values for {expected} x {size} ({interpolation} interpolation)",
                "one for each is needed",
                "author it again, or remove it",
            )


def _torn(attribute: Usd.Attribute, size: int, repair: MeshRepair) -> bool:
    """Return whether merged vertices differ in an attribute with `size` values per vertex."""
    old = np.flatnonzero(repair.new_index >= 0)
    into = repair.kept[repair.new_index[old]]
    values = [np.array(attribute.Get(time)) for time in _times(attribute)]
    return any(not np.array_equal(_taken(rows, old, size), _taken(rows, into, size)) for rows in values)


def _rewrite_subsets(prim: Usd.Prim, repair: MeshRepair) -> None:
    """Update subsets of faces and points."""
    faces = np.full(len(value(prim, "faceVertexCounts")), -1)
    faces[repair.polygons] = np.arange(len(repair.polygons))
    for child in prim.GetChildren():
        if child.IsA(UsdGeom.Subset):
            subset = UsdGeom.Subset(child)
            onto = faces if subset.GetElementTypeAttr().Get() == UsdGeom.Tokens.face else repair.new_index
            _change(subset.GetIndicesAttr(), partial(_renumbered, onto=onto))


def _renumbered(indices: Ints, onto: Ints) -> Ints:
    """Return the remaining indices, renumbered."""
    new = onto[indices]
    return np.unique(new[new >= 0])


def _taken(values: np.ndarray, rows: Ints, size: int = 1) -> np.ndarray:
    """Return the selected rows of a flat array with `size` values per row."""
    item = values.shape[1:]
    return values.reshape(-1, size, *item)[rows].reshape(-1, *item)


def _times(attribute: Usd.Attribute) -> list[Usd.TimeCode | float]:
    return attribute.GetTimeSamples() or [Usd.TimeCode.Default()]


def _change(attribute: Usd.Attribute, change: Change) -> None:
    """Replace the value of an attribute and each of its time samples."""
    if attribute.HasAuthoredValue():
        for time in _times(attribute):
            _set(attribute, change(np.array(attribute.Get(time))), time)


def _set(attribute: Usd.Attribute, rows: np.ndarray, time: Usd.TimeCode | float) -> None:
    kind = attribute.GetTypeName().type.pythonClass
    plain = np.ascontiguousarray(rows)
    attribute.Set(kind.FromNumpy(plain) if hasattr(kind, "FromNumpy") else kind(plain.tolist()), time)
