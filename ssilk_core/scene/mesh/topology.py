# SPDX-License-Identifier: Apache-2.0
"""Edges, hinges, components, areas and normals of triangle meshes (numpy only)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..assets import Floats, Ints, Mesh

NO_AREA = 1e-7  # ratio of twice a triangle's area to its longest edge squared; the limit of single precision
SLIVER = 50.0  # ratio of a triangle's longest edge to its height; clean cloth stays below 15
SAME_PLACE = 1e-6  # [m] size of the cells in which vertices count as coincident


def edges(faces: Ints) -> NDArray[np.int64]:
    """Return each undirected edge once, as (low, high) in ascending order, shape (E, 2)."""
    return edge_use(faces)[0]


def edge_use(faces: Ints) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the edges, shape (E, 2), and how many faces use each, shape (E,): 1 is a border, over 2 non-manifold."""
    half = np.sort(half_edges(faces), axis=1)
    _, first, uses = np.unique(edge_keys(half), return_index=True, return_counts=True)
    return half[first], uses


def half_edges(faces: Ints) -> NDArray[np.int64]:
    """Return the directed edges of every face in corner order, shape (3 F, 2)."""
    faces = np.asarray(faces, dtype=np.int64)
    return np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)


def edge_keys(pairs: Ints) -> NDArray[np.int64]:
    """Return one integer per pair of vertices (E, 2), independent of direction and ordered by (low, high)."""
    low, high = np.sort(pairs, axis=1).T
    return low * (high.max(initial=0) + 1) + high


def border_vertices(faces: Ints, vertex_count: int) -> NDArray[np.bool_]:
    """Return which vertices lie on an edge that only one face uses, shape (V,)."""
    pairs, uses = edge_use(faces)
    return vertex_mask(pairs[uses == 1], vertex_count)


def vertex_mask(indices: Ints, vertex_count: int) -> NDArray[np.bool_]:
    """Return a boolean mask over the vertices that is true at `indices` (any shape)."""
    mask = np.zeros(vertex_count, dtype=bool)
    mask[indices] = True
    return mask


def hinges(faces: Ints) -> NDArray[np.int64]:
    """Return the interior edges with their two opposite vertices, shape (H, 4).

    Each row is (v0, v1, o0, o1). The edge runs v0 -> v1 in the face of o0, and o1 belongs to the other face. Edges
    with one face or more than two have no hinge.
    """
    half, opposite = half_edges(faces), np.roll(faces, 1, axis=1).reshape(-1)
    _, group, uses = np.unique(edge_keys(half), return_inverse=True, return_counts=True)
    order = np.argsort(group, kind="stable")
    starts = np.concatenate([[0], np.cumsum(uses)[:-1]])[uses == 2]
    first, second = order[starts], order[starts + 1]
    return np.column_stack([half[first], opposite[first], opposite[second]])


def face_crosses(points: Floats, faces: Ints) -> Floats:
    """Return normals of the triangles, twice as long as each is large [m2], shape (F, 3)."""
    a, b, c = np.moveaxis(np.asarray(points, dtype=np.float64)[faces], 1, 0)
    return np.cross(b - a, c - a)


def face_normals(points: Floats, faces: Ints) -> Floats:
    """Return unit normals of the triangles, zero where one has no area, shape (F, 3)."""
    return _unit(face_crosses(points, faces))


def face_areas(points: Floats, faces: Ints) -> Floats:
    """Return triangle areas [m2], shape (F,)."""
    return 0.5 * np.linalg.norm(face_crosses(points, faces), axis=-1)


def vertex_areas(points: Floats, faces: Ints) -> Floats:
    """Return a third of the area of the faces around each vertex [m2], shape (V,)."""
    thirds = np.repeat(face_areas(points, faces) / 3, 3)
    return np.bincount(faces.reshape(-1), thirds, minlength=len(points)).astype(np.float64)


def vertex_normals(points: Floats, faces: Ints) -> Floats:
    """Return unit vertex normals, the area-weighted mean of the face normals around, shape (V, 3)."""
    crosses = np.repeat(face_crosses(points, faces), 3, axis=0)
    corners = faces.reshape(-1)
    return _unit(np.stack([np.bincount(corners, axis, minlength=len(points)) for axis in crosses.T], axis=-1))


def islands(faces: Ints, vertex_count: int) -> NDArray[np.int64]:
    """Return the connected component of each vertex, numbered by first vertex, shape (V,).

    An isolated vertex is a component.
    """
    return components(edges(faces), vertex_count)


def adrift(faces: Ints, island: Ints, held: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the numbers of islands (V,) of faces (F, 3) without any vertex that is `held`, shape (V,), ascending.

    Isolated vertices do not count.
    """
    return np.setdiff1d(island[np.unique(faces)], island[held])


def components(pairs: Ints, vertex_count: int) -> NDArray[np.int64]:
    """Return the component of each vertex under the edges `pairs` (E, 2), numbered by first vertex, shape (V,)."""
    label = np.arange(vertex_count)
    while True:
        lowest = np.minimum(label[pairs[:, 0]], label[pairs[:, 1]])
        merged = label.copy()
        # Both roots and vertices take the lower label, so that entire trees merge at once.
        for column in pairs.T:
            np.minimum.at(merged, label[column], lowest)
            np.minimum.at(merged, column, lowest)
        merged = merged[merged]
        if np.array_equal(merged, label):
            return np.unique(label, return_inverse=True)[1].reshape(-1)
        label = merged


def smooth(values: Floats, pairs: Ints, rounds: int, free: NDArray[np.bool_] | None = None) -> Floats:
    """Average each row of `values` (V, N) with those of its neighbours, `rounds` times.

    `pairs` (E, 2) are undirected edges. A vertex counts as its own neighbour. Constants are preserved. Where `free`
    (V,) is given, the other rows stay.
    """
    count = len(values)
    heads, tails = np.concatenate([pairs, pairs[:, ::-1]]).T
    share = 1.0 / (1 + np.bincount(heads, minlength=count))
    order = np.argsort(heads, kind="stable")
    heads, tails = heads[order], tails[order]
    owners, starts = np.unique(heads, return_index=True)
    result = np.array(values, dtype=np.float64)
    for _ in range(rounds):
        total = result.copy()
        if len(owners):
            total[owners] += np.add.reduceat(result[tails], starts, axis=0)
        averaged = total * share[:, None]
        result = averaged if free is None else np.where(free[:, None], averaged, result)
    return result


def _unit(vectors: Floats) -> Floats:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)


def merged_places(points: Floats) -> Ints:
    """Return a number for the place of each point, the same to a micrometre for those that coincide, shape (V,)."""
    return np.unique(np.round(points / SAME_PLACE), axis=0, return_inverse=True)[1].reshape(-1)


def subdivision_middles(n: int) -> Floats:
    """Return the barycentric coordinates of the middles of n^2 equal triangles in one, shape (n^2, 3)."""
    i, j = (index.reshape(-1) for index in np.mgrid[:n, :n])
    upward = np.stack([i, j], axis=1)[i + j < n] + 1 / 3
    downward = np.stack([i, j], axis=1)[i + j < n - 1] + 2 / 3
    second = np.concatenate([upward, downward]) / n
    return np.column_stack([1 - second.sum(axis=1), second])


def is_inside_out(points: Floats, faces: Ints) -> bool:
    """Return whether the normals of a closed mesh point inward: its faces enclose a negative volume."""
    a, b, c = np.moveaxis((points - points.mean(axis=0))[faces], 1, 0)
    return bool(np.einsum("fi,fi->", a, np.cross(b, c)) < 0)


def faces_among(mesh: Mesh, chosen: Ints) -> Ints:
    """Return the faces whose corners are all among `chosen` vertices, indexed within these, shape (F, 3)."""
    place = np.full(mesh.vertex_count, -1)
    place[chosen] = np.arange(len(chosen))
    faces = place[mesh.faces]
    return faces[(faces >= 0).all(axis=1)]
