# SPDX-License-Identifier: Apache-2.0
"""What can be wrong with a garment's mesh by itself."""

from __future__ import annotations

import numpy as np

from ..assets import Floats, Ints, Mesh
from ..mesh.topology import NO_AREA, SLIVER, edge_use, face_areas
from .finding import Finding, Findings, amount, listing

SAME_PLACE = 1e-6  # [m]; vertices closer than this share their place


def isolated_vertices(mesh: Mesh) -> Findings:
    """Yield the vertices that no face uses."""
    lone = np.setdiff1d(np.arange(mesh.vertex_count), mesh.faces)
    if len(lone):
        yield Finding(
            severity="error",
            code="isolated-vertices",
            prim=mesh.path,
            count=len(lone),
            found=f"in no face, of {mesh.vertex_count:,}",
            why="nothing holds them, so that no energy is defined for them",
            fix="delete loose geometry",
            fixable=True,
            elements="vertices",
            indices=listing(lone),
        )


def duplicate_vertices(mesh: Mesh, mergeable: Ints) -> Findings:
    """Yield the vertices that share their place with another one; `mergeable` (N,) are those that --fix merges."""
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
            found="at the same place as others: panels that are not sewn",
            why="the cloth comes apart there as soon as it moves",
            fix="merge by distance, unless the cloth is meant to open there"
            + (
                "" if merged.all() else f" (--fix merges {np.count_nonzero(merged)}, whose weights and classes agree)"
            ),
            fixable=bool(merged.all()),
            elements="vertices",
            indices=listing(copies),
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
            found="with the same vertices as an earlier one",
            why="the cloth is twice as heavy and stiff there, and does not bend along their edges",
            fix="delete the doubles",
            fixable=True,
            elements="faces",
            indices=listing(copies),
        )


def non_manifold_edges(mesh: Mesh) -> Findings:
    """Yield the edges that more than two faces use; doubles and collapsed faces, told elsewhere, do not count."""
    pairs, uses = edge_use(distinct_faces(mesh.faces))
    bad = pairs[uses > 2]
    if len(bad):
        yield Finding(
            severity="warning",
            code="non-manifold-edges",
            prim=mesh.path,
            count=len(np.unique(bad)),
            found=f"on {amount(len(bad), 'edges')} of more than two triangles",
            why="cloth does not bend along such an edge, and distances along the cloth are less exact",
            fix="delete inner faces, or split the parts that meet there",
            elements="vertices",
            indices=listing(np.unique(bad)),
        )


def degenerate_faces(mesh: Mesh, collapsing: int) -> Findings:
    """Yield the triangles without area and, apart, slivers; `collapsing` is how many of the former --fix removes."""
    longest, area = _longest_edges(mesh), face_areas(mesh.points, mesh.faces)
    flat = 2 * area <= NO_AREA * longest**2
    sliver = ~flat & (longest**2 > SLIVER * 2 * area)
    if flat.any():
        yield Finding(
            severity="error",
            code="degenerate-faces",
            prim=mesh.path,
            count=int(flat.sum()),
            found=f"without area, of {len(mesh.faces):,}",
            why="a membrane without area has no energy, and training refuses it",
            fix="dissolve degenerate geometry"
            + ("" if collapsing else "; --fix removes only faces whose corners coincide, others would leave a slit"),
            fixable=collapsing == flat.sum(),
            elements="faces",
            indices=listing(np.flatnonzero(flat)),
        )
    if sliver.any():
        yield Finding(
            severity="warning",
            code="sliver-faces",
            prim=mesh.path,
            count=int(sliver.sum()),
            found=f"more than {SLIVER:.0f} times as long as high",
            why="the cloth is wrong there: slivers resist less than they should, so as not to outweigh all else",
            fix="collapse their short edges or remesh",
            elements="faces",
            indices=listing(np.flatnonzero(sliver)),
        )


def distinct_faces(faces: Ints) -> Ints:
    """Return each triangle with three different corners once, as its sorted corners, shape (N, 3)."""
    corners = np.unique(np.sort(faces, axis=1), axis=0)
    return corners[(np.diff(corners, axis=1) > 0).all(axis=1)]


def shared_places(points: Floats) -> Ints:
    """Return which points share their place, to a micrometre, with another, as a mask (V,)."""
    _, place, uses = np.unique(np.round(points / SAME_PLACE), axis=0, return_inverse=True, return_counts=True)
    return uses[place.reshape(-1)] > 1


def _longest_edges(mesh: Mesh) -> Floats:
    corners = mesh.points[mesh.faces]
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max(axis=1)
