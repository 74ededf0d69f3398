# SPDX-License-Identifier: Apache-2.0
"""Which way polygons face: alike within a surface, and away from the body."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..assets import Floats, Ints, Mesh
from ..mesh.topology import components, edge_keys
from ..setup.surface import closest_on_surface
from .finding import Finding, Findings, listing

Mask = NDArray[np.bool_]
# Share of a surface that must face the body before it counts as inside out; cloth that hangs free faces anywhere.
INWARD = 0.75


def inconsistent_winding(mesh: Mesh) -> Findings:
    """Yield the triangles that are wound against most others of their surface."""
    flips, surface = consistent_flips(np.full(len(mesh.faces), 3), mesh.faces.reshape(-1))
    wrong = np.flatnonzero(_minority(flips, surface))
    if len(wrong):
        yield Finding(
            severity="warning",
            code="inconsistent-winding",
            prim=mesh.path,
            count=len(wrong),
            found=f"wound against their neighbours, of {len(mesh.faces):,}",
            why="normals jump there: shading breaks, and proxies and classes are placed by normals",
            fix="recalculate the normals of the mesh",
            fixable=True,
            elements="faces",
            indices=listing(wrong),
        )


def inside_out(mesh: Mesh, body: Mesh) -> Findings:
    """Yield the triangles of surfaces whose normals point into the body, when all are wound alike."""
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
            found=f"on surfaces that face the body, of {len(mesh.faces):,}",
            why="it is shaded from the wrong side, and proxies are turned the wrong way",
            fix="flip the normals of the mesh",
            fixable=True,
            elements="faces",
            indices=listing(wrong),
        )


def outward_flips(points: Floats, counts: Ints, corners: Ints, body: Mesh) -> Mask:
    """Return which polygons to flip so that each surface is wound alike and does not face the body, shape (P,)."""
    flips, surface = consistent_flips(counts, corners)
    flips = _minority(flips, surface)
    inward = inward_share(points, counts, corners, flips, surface, body)
    return flips ^ (inward > INWARD)[surface]


def consistent_flips(counts: Ints, corners: Ints) -> tuple[Mask, Ints]:
    """Wind the polygons of each surface like its first one.

    A surface is what hangs together by edges that two polygons share; one that cannot be oriented stays as it is.

    Args:
        counts: corners of each polygon, shape (P,).
        corners: their vertices, one polygon after another, shape (sum of counts,).

    Returns:
        Which polygons to flip, shape (P,), and the surface of each, numbered from 0, shape (P,).
    """
    count = len(counts)
    first, second, alike = _shared_edges(counts, corners)
    # Each polygon stands twice, as it is and flipped (+ count); edges tie what agrees, so that a surface falls into
    # two mirror images. The one that holds its first polygon as it is has the lower number.
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
    """Return `flips` (P,), or for a surface of which they are more than half, all others."""
    mostly = 2 * np.bincount(surface, flips) > np.bincount(surface)
    return flips ^ mostly[surface]


def _shared_edges(counts: Ints, corners: Ints) -> tuple[Ints, Ints, Mask]:
    """Return the two polygons at each edge that exactly two share, and whether both run along it the same way."""
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
