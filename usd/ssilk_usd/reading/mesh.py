# SPDX-License-Identifier: Apache-2.0
"""Convert UsdGeom meshes to core meshes: points, triangles and polygons, with texture coordinates of `uv_sets`."""

from __future__ import annotations

import numpy as np
from pxr import Usd, UsdGeom, UsdSkel

from ssilk_core.errors import fail
from ssilk_core.scene.assets import Floats, Ints, Mesh

from ..names import CLASS, GARMENT, GEOM_BIND, PROXIES, RIDES_ON, SKEL
from ..opening.stage import (
    EARLIEST,
    apply,
    column_matrix,
    has_value,
    inherited,
    inherited_target,
    location,
    value,
    world_matrix,
)
from ..opening.times import change_times, visibility_attributes
from .polygons import triangulate
from .uv_sets import texture_coordinates


def is_garment(prim: Usd.Prim) -> bool:
    """Return whether a mesh has vertex classes, a proxy rig, or `ssilk:garment = true`."""
    return has_value(prim, CLASS) or has_value(prim, PROXIES) or value(prim, GARMENT) is True


def is_rider(prim: Usd.Prim) -> bool:
    """Return whether a prim, or one above it, says which garment it rides on."""
    found = inherited(prim, RIDES_ON)
    return isinstance(found, Usd.Relationship) and bool(found.GetTargets())


def is_body(prim: Usd.Prim) -> bool:
    """Return whether a mesh is neither a garment nor rides on one."""
    return not is_garment(prim) and not is_rider(prim)


def is_drawn(prim: Usd.Prim) -> bool:
    """Return whether a prim is visible at any time and not a guide."""
    imageable = UsdGeom.Imageable(prim)
    times = [EARLIEST, *change_times(visibility_attributes(prim))]
    visible = any(imageable.ComputeVisibility(time) != UsdGeom.Tokens.invisible for time in times)
    return visible and imageable.ComputePurpose() != UsdGeom.Tokens.guide


def is_stand_in(prim: Usd.Prim) -> bool:
    """Return whether a prim is drawn in viewports alone, in place of what is rendered."""
    return bool(UsdGeom.Imageable(prim).ComputePurpose() == UsdGeom.Tokens.proxy)


def rendered(prims: list[Usd.Prim]) -> list[Usd.Prim]:
    """Return the prims that a render shows, or all where none of them is."""
    return [prim for prim in prims if not is_stand_in(prim)] or prims


def display_colour(prim: Usd.Prim) -> tuple[float, float, float] | None:
    """Return the mean of a mesh's displayColor, of linear light, each from 0 to 1; None without finite colours."""
    primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance("displayColor")
    found = np.asarray(primvar.ComputeFlattened(EARLIEST)) if primvar and primvar.HasAuthoredValue() else None
    # Any type may be authored under this name.
    if found is None or found.dtype.kind != "f" or not found.size or found.shape[1:] != (3,):
        return None
    if not np.isfinite(found).all():
        return None
    red, green, blue = found.astype(np.float64).mean(axis=0).clip(0, 1).tolist()
    return red, green, blue


def read_mesh(prim: Usd.Prim, to_core: Floats, offsets: Floats | None = None) -> Mesh:
    """Read a UsdGeom.Mesh; its earliest points are its rest shape.

    Args:
        prim: the mesh. Hole faces are omitted, and faces that run clockwise are reversed.
        to_core: transform from the mesh's local space to the core's bind space [m], column vectors, shape (4, 4).
        offsets: of the points, in local space, which blendshapes move, shape (V, 3).

    Raises:
        SsilkError: counts, indices or texture coordinates do not match, or points are not finite.
    """
    where = location(prim)
    points = np.array(value(prim, "points") or [], dtype=np.float64).reshape(-1, 3)
    points = points if offsets is None else points + offsets
    counts, indices = polygons(prim, len(points), where)
    corners, counts, _ = kept_faces(prim, counts)
    uvs = texture_coordinates(prim, indices)
    return Mesh(
        where,
        apply(to_core, points),
        triangulate(points, counts, indices[corners]),
        counts,
        indices[corners],
        None if uvs is None else uvs[corners],
    )


def polygons(prim: Usd.Prim, point_count: int, where: str) -> tuple[Ints, Ints]:
    """Return checked face vertex counts and indices."""
    counts = np.array(value(prim, "faceVertexCounts") or [], dtype=np.int64)
    indices = np.array(value(prim, "faceVertexIndices") or [], dtype=np.int64)
    few = int(np.count_nonzero(counts < 3))
    if few:
        fail(where, f"{few} faces have fewer than three corners", "a face has three or more", "remove them")
    if counts.sum() != len(indices):
        fail(
            where,
            f"faceVertexCounts add up to {counts.sum()} but there are {len(indices)} faceVertexIndices",
            "both must match",
            "export the mesh again",
        )
    bad = int(np.count_nonzero((indices < 0) | (indices >= point_count)))
    if bad:
        fail(
            where,
            f"{bad} face indices lie outside 0 to {point_count - 1}",
            "an index names a point of the mesh",
            "export the mesh again",
        )
    return counts, indices


def kept_faces(prim: Usd.Prim, counts: Ints) -> tuple[Ints, Ints, Ints]:
    """Return face corners to keep, counter-clockwise from outside, the vertex counts of their faces, and these."""
    keep = np.ones(len(counts), dtype=bool)
    holes = np.array(value(prim, "holeIndices") or [], dtype=np.int64)
    keep[holes[(holes >= 0) & (holes < len(counts))]] = False
    starts = np.cumsum(counts) - counts
    step = -1 if winds_backwards(prim) else 1
    corners = [np.arange(start, start + count)[::step] for start, count in zip(starts[keep], counts[keep])]
    return np.concatenate(corners) if corners else np.zeros(0, dtype=np.int64), counts[keep], np.flatnonzero(keep)


def winds_backwards(prim: Usd.Prim) -> bool:
    """Return whether a mesh's faces run clockwise from outside, where it is placed.

    Left-handed ones do, and what places the mesh turns either kind into the other where it mirrors: its xforms, or
    the geomBindTransform of a skinned mesh, whose xforms UsdSkel ignores.
    """
    left_handed = value(prim, "orientation") == UsdGeom.Tokens.leftHanded
    return bool(left_handed != (np.linalg.det(placement(prim)[:3, :3]) < 0))


def placement(prim: Usd.Prim) -> Floats:
    """Return what places a mesh's points: to bind space where it is skinned, else to the world, shape (4, 4)."""
    bound = inherited_target(prim, "skel:skeleton")
    if not (bound and bound.IsA(UsdSkel.Skeleton) and inherited(prim, SKEL[0])):
        return world_matrix(prim)
    bind = inherited(prim, GEOM_BIND)
    matrix = None if bind is None else bind.Get(EARLIEST)
    return np.eye(4) if matrix is None else column_matrix(matrix)
