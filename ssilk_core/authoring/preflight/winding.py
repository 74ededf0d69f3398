# SPDX-License-Identifier: Apache-2.0
"""Check that polygons are wound consistently within a surface and face away from the body."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...scene.assets import Floats, Ints, Mesh
from ...scene.mesh.topology import components, edge_keys
from ..setup.surface import closest_on_surface
from .finding import Finding, Findings, index_tuple

Mask = NDArray[np.bool_]
# Share of a surface's area that faces the body above which it is inside out; hanging cloth may face any direction.
INWARD = 0.75


def inconsistent_winding(mesh: Mesh) -> Findings:
    """Yield the triangles whose winding is opposite to that of most others of their surface."""
    flips, surface = consistent_flips(np.full(len(mesh.faces), 3), mesh.faces.reshape(-1))
    wrong = np.flatnonzero(_minority(flips, surface))
    if len(wrong):
        yield Finding(
            severity="warning",
            code="inconsistent-winding",
            prim=mesh.path,
            count=len(wrong),
            found=f"wound opposite to their neighbours, out of {len(mesh.faces):,}",
            why="normals flip there: shading breaks, and proxies and classes depend on normals",
            fix="recalculate the normals of the mesh",
            fixable=True,
            elements="faces",
            indices=index_tuple(wrong),
        )


def inside_out(mesh: Mesh, body: Mesh) -> Findings:
    """Yield the triangles of surfaces whose normals point into the body once they are wound consistently."""
    counts, corners = np.full(len(mesh.faces), 3), mesh.faces.reshape(-1)
    flips, surface = consistent_flips(counts, corners)
    flips = _minority(flips, surface)
    inward = inward_share(mesh.points, counts, corners, flips, surface, body)
    wrong = np.flatnonzero((inward > INWARD)[surface])
    if len(wrong):
        yield Finding(
            severity="warning",
            code="inside-out",
            prim=mesh.path,
            count=len(wrong),
            found=f"on surfaces that face the body, out of {len(mesh.faces):,}",
            why="shading uses the wrong side, and proxies have the wrong orientation",
            fix="flip the normals of the mesh",
            fixable=True,
            elements="faces",
            indices=index_tuple(wrong),
        )


def outward_flips(points: Floats, counts: Ints, corners: Ints, body: Mesh) -> Mask:
    """Return which polygons to flip so that each surface has one winding and faces away from the body, shape (P,)."""
    flips, surface = consistent_flips(counts, corners)
    flips = _minority(flips, surface)
    inward = inward_share(points, counts, corners, flips, surface, body)
    return flips ^ (inward > INWARD)[surface]


def consistent_flips(counts: Ints, corners: Ints) -> tuple[Mask, Ints]:
    """Find the flips that wind all polygons of a surface like its first one.

    A surface is a set of polygons connected by edges that exactly two of them share. A non-orientable surface is
    not changed.

    Args:
        counts: number of corners of each polygon, shape (P,).
        corners: vertices of the corners, polygon by polygon, shape (sum of counts,).

    Returns:
        Which polygons to flip, shape (P,), and the surface of each, numbered from 0, shape (P,).
    """
    count = len(counts)
    first, second, alike = _shared_edges(counts, corners)
    # Each polygon has two nodes: unflipped, and flipped (+ count). Edges connect nodes with the same winding, so a
    # surface forms two mirrored components. The one with the first polygon unflipped has the lower label.
    mirrored = np.where(alike, count, 0)
    pairs = np.concatenate([
        np.column_stack([first, second + mirrored]), np.column_stack([first + count, second + count - mirrored]),
    ])  # fmt: skip
    label = components(pairs, 2 * count)
    as_is, flipped = label[:count], label[count:]
    surface = np.unique(np.minimum(as_is, flipped), return_inverse=True)[1].reshape(-1)
    return as_is > flipped, surface


def inward_share(points: Floats, counts: Ints, corners: Ints, flips: Mask, surface: Ints, body: Mesh) -> Floats:
    """Return the share of each surface's area that faces the nearest point of the body, shape (surfaces,)."""
    area, centre = _area_vectors(points, counts, corners)
    area *= np.where(flips, -1.0, 1.0)[:, None]
    outward = closest_on_surface(centre, body).normals
    size = np.linalg.norm(area, axis=1)
    inward = np.bincount(surface, np.where((area * outward).sum(axis=1) < 0, size, 0.0))
    return inward / np.maximum(np.bincount(surface, size), 1e-30)


def _minority(flips: Mask, surface: Ints) -> Mask:
    """Return `flips` (P,), inverted on each surface where they are more than half."""
    mostly = 2 * np.bincount(surface, flips) > np.bincount(surface)
    return flips ^ mostly[surface]


def _shared_edges(counts: Ints, corners: Ints) -> tuple[Ints, Ints, Mask]:
    """Return the two polygons at each edge with exactly two, and whether both traverse it in the same direction."""
    owner = np.repeat(np.arange(len(counts)), counts)
    after = np.arange(len(corners)) + 1
    after[np.cumsum(counts) - 1] -= counts
    pairs = np.column_stack([corners, corners[after]])
    _, group, uses = np.unique(edge_keys(pairs), return_inverse=True, return_counts=True)
    order = np.argsort(group.reshape(-1), kind="stable")
    start = (np.cumsum(uses) - uses)[uses == 2]
    first, second = order[start], order[start + 1]
    return owner[first], owner[second], pairs[first, 0] == pairs[second, 0]


def _area_vectors(points: Floats, counts: Ints, corners: Ints) -> tuple[Floats, Floats]:
    """Return the area vector (Newell) and the centre of each polygon, both (P, 3)."""
    start = np.cumsum(counts) - counts
    after = np.arange(len(corners)) + 1
    after[np.cumsum(counts) - 1] -= counts
    centre = np.add.reduceat(points[corners], start) / counts[:, None]
    local = points[corners] - np.repeat(centre, counts, axis=0)
    return np.add.reduceat(np.cross(local, local[after]), start) / 2, centre
