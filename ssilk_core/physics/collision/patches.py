# SPDX-License-Identifier: Apache-2.0
"""The patch of the body that lies beneath each point of tight cloth in the bind pose."""

from __future__ import annotations

import numpy as np

from ...scene.assets import Floats, Ints, Mesh
from ...scene.mesh import topology
from ...scene.mesh.geodesic import edge_graph
from .distance import MAX_QUERY_DISTANCE

PATCH_RADIUS = 1 / 12  # geodesic, relative to the diagonal of the body's bounding box: half the girth of an upper arm
MAX_PATCH_VERTICES = 256  # on a finer body the patch is smaller than its radius
SOURCES_PER_BATCH = 512  # of geodesic distances
COINCIDENT_DISTANCE = 1e-6  # [m]


def patches_beneath(points: Floats, body: Mesh, chosen: Ints) -> Ints:
    """Return the patch of the body beneath each point (T, 3) in the bind pose.

    A patch holds the vertices within `PATCH_RADIUS`, along the body's edges, of the vertex nearest to the point whose
    normals point into the same half-space. Coincident vertices count as connected, because bodies are split at seams
    or come in parts.

    Returns:
        The number of vertices, then their indices into `chosen`, nearest first, padded with the nearest one, shape
        (T, 1 + C); no vertices for a point far from the body.
    """
    from scipy.spatial import cKDTree

    if not len(points) or not len(chosen):
        return np.zeros((len(points), 2), dtype=np.int64)
    distance, nearest = cKDTree(body.points[chosen]).query(points)
    anchors, which = np.unique(nearest, return_inverse=True)
    patches = _patches(body, chosen, anchors)[which]
    patches[distance > MAX_QUERY_DISTANCE, 0] = 0
    return patches


def _patches(body: Mesh, chosen: Ints, anchors: Ints) -> Ints:
    """Return the patch around each vertex `chosen[anchors]`, (A, 1 + C), in the format of `patches_beneath`."""
    from scipy.sparse.csgraph import dijkstra
    from scipy.spatial import cKDTree

    joined = cKDTree(body.points).query_pairs(COINCIDENT_DISTANCE, output_type="ndarray")
    pairs = np.unique(np.concatenate([topology.edges(body.faces), joined]), axis=0)
    graph = edge_graph(body.points, pairs)
    normals = topology.vertex_normals(body.points, body.faces)[chosen]
    extent = PATCH_RADIUS * body.diagonal
    patches = []
    for start in range(0, len(anchors), SOURCES_PER_BATCH):
        part = anchors[start : start + SOURCES_PER_BATCH]
        along = dijkstra(graph, directed=False, indices=chosen[part], limit=extent)[:, chosen]
        along[normals[part] @ normals.T <= 0] = np.inf
        along[np.arange(len(part)), part] = 0
        order = np.argsort(along, axis=1, kind="stable")[:, :MAX_PATCH_VERTICES]
        within = np.isfinite(np.take_along_axis(along, order, axis=1))
        patches.append(np.column_stack([within.sum(axis=1), np.where(within, order, order[:, :1])]))
    found = np.concatenate(patches)
    return found[:, : 1 + found[:, 0].max()]


def faces_around(patches: Ints, faces: Ints, count: int) -> Ints:
    """Return the faces with a corner in each patch (T, 1 + C) of `count` vertices, padded with -1, shape (T, L)."""
    owner = np.repeat(np.arange(len(faces)), 3)[np.argsort(faces.reshape(-1), kind="stable")]
    ends = np.cumsum(np.bincount(faces.reshape(-1), minlength=count))
    around = np.split(owner, ends[:-1])
    kinds, which = np.unique(patches, axis=0, return_inverse=True)
    found = [np.unique(np.concatenate([around[vertex] for vertex in row[:size]])) for size, *row in kinds.tolist()]
    table = np.full((len(found), max(1, *map(len, found))), -1)
    for row, own in zip(table, found):
        row[: len(own)] = own
    return table[which.reshape(-1)]
