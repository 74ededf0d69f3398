# SPDX-License-Identifier: Apache-2.0
"""Check a garment's mesh on its own."""

from __future__ import annotations

import numpy as np

from ...events import format_count
from ...physics.skin.blocked_rays import NO_TRIANGLE, BlockedRays
from ...scene.assets import Floats, Ints, Mesh
from ...scene.mesh.topology import NO_AREA, SLIVER, edge_use, face_areas, islands, merged_places
from .finding import Finding, Findings, index_tuple

SHELL = (2e-4, 0.015)  # [m] between the layers of cloth with thickness
SHELL_SHARE, SHELL_SPREAD = 0.8, 3.0  # of its faces that have a layer behind them; between thick and thin places
LARGE = 0.2  # of a garment's area, from which on an island is cloth, and no button
LOOKED_AT = 1000  # of an island's faces, drawn: their share is known to some hundredths
BACK_TO_BACK = -0.7  # cosine between the normals of two layers


def isolated_vertices(mesh: Mesh) -> Findings:
    """Yield the vertices that no face uses."""
    lone = np.setdiff1d(np.arange(mesh.vertex_count), mesh.faces)
    if len(lone):
        yield Finding(
            severity="error",
            code="isolated-vertices",
            prim=mesh.path,
            count=len(lone),
            found=f"not used by any face, out of {mesh.vertex_count:,}",
            why="they have no mass and nothing attaches them",
            fix="delete loose geometry",
            fixable=True,
            elements="vertices",
            indices=index_tuple(lone),
        )


def duplicate_vertices(mesh: Mesh, mergeable: Ints) -> Findings:
    """Yield the vertices that coincide with another; `mergeable` (N,) are those that --fix merges."""
    copies = np.setdiff1d(
        np.flatnonzero(shared_places(mesh.points)), np.setdiff1d(np.arange(mesh.vertex_count), mesh.faces)
    )
    if len(copies):
        merged = np.isin(copies, mergeable)
        yield Finding(
            severity="warning",
            code="duplicate-vertices",
            prim=mesh.path,
            count=len(copies),
            found="at the same position as others: panels that are not sewn",
            why="the cloth comes apart there as soon as it moves, or folds freely where stitches join islands",
            fix="merge by distance, unless the cloth is meant to open there"
            + (
                "" if merged.all() else f" (--fix merges {np.count_nonzero(merged)}, whose weights and classes agree)"
            ),
            fixable=bool(merged.all()),
            elements="vertices",
            indices=index_tuple(copies),
        )


def duplicate_faces(mesh: Mesh) -> Findings:
    """Yield the triangles that have the same vertices as an earlier one."""
    _, first = np.unique(np.sort(mesh.faces, axis=1), axis=0, return_index=True)
    copies = np.setdiff1d(np.arange(len(mesh.faces)), first)
    if len(copies):
        yield Finding(
            severity="warning",
            code="duplicate-faces",
            prim=mesh.path,
            count=len(copies),
            found="with the same vertices as an earlier face",
            why="the cloth is twice as heavy and stiff there, and does not bend along their edges",
            fix="delete the duplicates",
            fixable=True,
            elements="faces",
            indices=index_tuple(copies),
        )


def non_manifold_edges(mesh: Mesh) -> Findings:
    """Yield the edges that more than two faces use; duplicate and collapsed faces do not count."""
    pairs, uses = edge_use(distinct_faces(mesh.faces))
    bad = pairs[uses > 2]
    if len(bad):
        yield Finding(
            severity="warning",
            code="non-manifold-edges",
            prim=mesh.path,
            count=len(np.unique(bad)),
            found=f"on {format_count(len(bad), 'edges')} shared by more than two triangles",
            why="cloth does not bend along such an edge, and geodesic distances are less accurate",
            fix="delete inner faces, or split the parts that meet there",
            elements="vertices",
            indices=index_tuple(np.unique(bad)),
        )


def degenerate_faces(mesh: Mesh, collapsing: int) -> Findings:
    """Yield the triangles with zero area, of which --fix removes `collapsing`, and separately the slivers."""
    longest, area = _longest_edges(mesh), face_areas(mesh.points, mesh.faces)
    flat = 2 * area <= NO_AREA * longest**2
    sliver = ~flat & (longest**2 > SLIVER * 2 * area)
    if flat.any():
        yield Finding(
            severity="error",
            code="degenerate-faces",
            prim=mesh.path,
            count=int(flat.sum()),
            found=f"with zero area, out of {len(mesh.faces):,}",
            why="the membrane energy is undefined on a triangle with zero area, and training refuses it",
            fix="dissolve degenerate geometry"
            + ("" if collapsing else "; --fix removes only faces whose corners coincide; others would leave a slit"),
            fixable=collapsing == flat.sum(),
            elements="faces",
            indices=index_tuple(np.flatnonzero(flat)),
        )
    if sliver.any():
        yield Finding(
            severity="warning",
            code="sliver-faces",
            prim=mesh.path,
            count=int(sliver.sum()),
            found=f"more than {SLIVER:.0f} times as long as high",
            why="the cloth is too soft there: the stiffness of slivers is limited so that they do not dominate",
            fix="collapse their short edges or remesh",
            elements="faces",
            indices=index_tuple(np.flatnonzero(sliver)),
        )


def two_layers(mesh: Mesh) -> Findings:
    """Yield large islands that are shells: nearly everywhere another layer of them is behind, at about one distance.

    Pleats have layers at many distances. Small islands may be buttons, and what is up to some four times as wide as
    thick, such as a cord, is solid.
    """
    look, corners = _Sight(mesh), mesh.points[mesh.faces]
    flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(flat, axis=1)
    flat /= areas.clip(1e-30)[:, None]
    island = islands(mesh.faces, mesh.vertex_count)[mesh.faces[:, 0]]
    numbers, group = np.unique(island, return_inverse=True)
    large = np.bincount(group, areas) >= LARGE * areas.sum()
    for number in numbers[large]:
        own = np.flatnonzero(island == number)
        some = np.random.default_rng(0).permutation(own)[:LOOKED_AT]
        starts, normals = corners[some].mean(axis=1), flat[some]
        for side in (-1, 1):  # as it is wound, or inside out
            met, away = look.along(starts, side * normals, *SHELL)
            opposite = np.sum(normals * flat[met], axis=1) < BACK_TO_BACK
            backs = (met != NO_TRIANGLE) & (island[met] == number) & opposite
            if backs.mean() < SHELL_SHARE:
                continue
            thin, thick = np.percentile(away[backs], (10, 90))
            middles = starts[backs] + side * away[backs, None] / 2 * normals[backs]
            if thick > SHELL_SPREAD * thin or look.is_narrow(middles, normals[backs], away[backs]):
                continue
            vertices, apart = np.unique(mesh.faces[own]), 1000 * np.median(away[backs])
            yield Finding(
                severity="warning",
                code="two-layers",
                prim=mesh.path,
                count=len(vertices),
                found=f"cloth with thickness: one piece whose two layers are {apart:.1f} mm apart",
                why="each layer is cloth of its own: it weighs and costs twice as much, and one passes through the "
                "other",
                fix="delete one layer, and give it thickness on top: in USD let the whole mesh ride on it as a trim "
                "(ssilk:rideSoft), in Blender put a Solidify modifier below the Armature modifier",
                elements="vertices",
                indices=index_tuple(vertices),
            )


class _Sight:
    """Looks for a mesh's triangles along rays."""

    def __init__(self, mesh: Mesh) -> None:
        self._rays, self._origin = BlockedRays(mesh.points, mesh.faces), mesh.points.mean(axis=0)
        self._points = (mesh.points - self._origin).astype(np.float32)

    def along(self, starts: Floats, directions: Floats, low: float, high: Floats | float) -> tuple[Ints, Floats]:
        """Return a triangle that each ray (R, 3) meets from `low` to `high` [m], and where, as `BlockedRays.find`."""
        count = len(starts)
        start, direction = (starts - self._origin).astype(np.float32), directions.astype(np.float32)
        least, most = np.full(count, low, np.float32), np.full(count, high, np.float32)
        return self._rays.find(self._points, start, direction, least, most, np.full(count, NO_TRIANGLE))

    def is_narrow(self, middles: Floats, normals: Floats, thickness: Floats) -> bool:
        """Return whether most points (R, 3) midway between layers have a side as near as the layers are apart."""
        first = np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=1)])
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        second = np.cross(normals, first)
        sides: list[Floats] = [first, second, -first, -second]
        met = [self.along(middles, side, 0.0, thickness)[0] != NO_TRIANGLE for side in sides]
        return bool(np.any(met, axis=0).mean() > 0.5)


def distinct_faces(faces: Ints) -> Ints:
    """Return each triangle with three distinct corners once, with sorted corners, shape (N, 3)."""
    corners = np.unique(np.sort(faces, axis=1), axis=0)
    return corners[(np.diff(corners, axis=1) > 0).all(axis=1)]


def shared_places(points: Floats) -> Ints:
    """Return which points coincide with another to a micrometre, shape (V,)."""
    place = merged_places(points)
    return np.bincount(place)[place] > 1


def _longest_edges(mesh: Mesh) -> Floats:
    corners = mesh.points[mesh.faces]
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max(axis=1)
