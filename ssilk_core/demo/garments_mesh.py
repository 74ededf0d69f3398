# SPDX-License-Identifier: Apache-2.0
"""Even triangle meshes from surfaces given as grids of points, and holes cut into them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..scene.assets import Floats, Ints
from ..scene.mesh.topology import border_vertices, edge_use


def along(line: Floats, count: int) -> Floats:
    """Return `count` points spaced evenly along a polyline (N, 3), ends included."""
    steps = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    at = np.linspace(0, steps[-1], count)
    return np.stack([np.interp(at, steps, axis) for axis in line.T], axis=1)


def length(line: Floats) -> float:
    """Return the length of a polyline [m]."""
    return float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())


def loft(grid: Floats, edge: float, *, closed: bool = False) -> tuple[Floats, Ints]:
    """Mesh a surface given as a grid of points with triangles of about `edge` [m].

    Args:
        grid: rows from top to bottom, each running so that (row, down) spans the outside, shape (R, C, 3);
            with `closed`, the last column repeats the first.

    Returns:
        Points (V, 3) and faces (F, 3). Rows get as many vertices as their length asks for.
    """
    down = np.mean([length(grid[:, column]) for column in range(grid.shape[1])])
    count = max(2, round(down / (edge * np.sqrt(3) / 2))) + 1
    columns = np.stack([along(grid[:, column], count) for column in range(grid.shape[1])], axis=1)
    rows = [along(row, max(3, round(length(row) / edge)) + 1) for row in columns]
    if closed:
        rows = [row[:-1] for row in rows]
    starts = np.cumsum([0] + [len(row) for row in rows])
    strips = [
        stitch(above, below, start, stop, closed=closed)
        for above, below, start, stop in zip(rows, rows[1:], starts, starts[1:])
    ]
    return np.concatenate(rows), np.concatenate(strips)


def stitch(above: Floats, below: Floats, start: int, stop: int, *, closed: bool) -> Ints:
    """Return triangles between two rows of points numbered from `start` and `stop`, taking the shorter diagonal."""
    n, m = len(above), len(below)
    last_n, last_m = (n, m) if closed else (n - 1, m - 1)
    faces, i, j = [], 0, 0
    while i < last_n or j < last_m:
        right = np.linalg.norm(above[(i + 1) % n] - below[j % m]) if i < last_n else np.inf
        left = np.linalg.norm(above[i % n] - below[(j + 1) % m]) if j < last_m else np.inf
        if right <= left:
            faces.append((start + i % n, start + (i + 1) % n, stop + j % m))
            i += 1
        else:
            faces.append((start + i % n, stop + (j + 1) % m, stop + j % m))
            j += 1
    return np.array(faces)


def cap(points: Floats, faces: Ints, rim: int) -> tuple[Floats, Ints]:
    """Close the first `rim` points, the top row of a closed loft, by a fan round their middle."""
    row = np.arange(rim)
    fan = np.stack([np.roll(row, -1), row, np.full(rim, len(points))], axis=1)
    return np.concatenate([points, points[:rim].mean(axis=0, keepdims=True)]), np.concatenate([faces, fan])


def cut(points: Floats, faces: Ints, inside: Callable[[Floats], Floats], edge: float) -> tuple[Floats, Ints]:
    """Cut a hole: drop the faces inside, draw the rim onto the line where `inside` is zero, even out what is near.

    Args:
        inside: says how far points (N, 3) lie inside the hole [m], negative outside.
        edge: length of the edges [m].
    """
    faces = trim(faces[inside(points[faces].mean(axis=1)) < 0], len(points))
    used, faces = np.unique(faces, return_inverse=True)
    points, faces = points[used], faces.reshape(-1, 3)
    near = np.abs(inside(points)) < 3 * edge
    rim, pull = averaging(faces, len(points))
    moving = np.flatnonzero(near)
    hem = np.flatnonzero(near & rim)
    for _ in range(12):
        points = points.copy()
        points[moving] += 0.5 * (pull @ points - points)[moving]
        points[hem] = onto(points[hem], inside)
    return points, faces


def trim(faces: Ints, count: int) -> Ints:
    """Return faces without those that hang on the rest by one edge or lie on the rim with all corners."""
    while True:
        flat = border_vertices(faces, count)[faces].all(axis=1)
        if not flat.any():
            return faces
        faces = faces[~flat]


def averaging(faces: Ints, count: int) -> tuple[NDArray[np.bool_], Any]:
    """Return which points lie on a rim, and the matrix that averages neighbours; on a rim, along it alone."""
    from scipy.sparse import coo_array, diags_array

    edges, uses = edge_use(faces)
    rim = border_vertices(faces, count)
    both = np.concatenate([edges, edges[:, ::-1]])
    open_edge = np.tile(uses == 1, 2)
    both = both[open_edge | ~rim[both[:, 0]]]
    matrix = coo_array((np.ones(len(both)), both.T), shape=(count, count)).tocsr()
    return rim, diags_array(1 / np.maximum(matrix.sum(axis=1), 1)) @ matrix


def onto(points: Floats, inside: Callable[[Floats], Floats]) -> Floats:
    """Return points (N, 3) moved to where `inside` is zero, by one step of Newton's method."""
    value, small = inside(points), 1e-4
    slope = np.stack([inside(points + small * axis) - value for axis in np.eye(3)], axis=1) / small
    step = value[:, None] * slope / np.maximum((slope**2).sum(axis=1, keepdims=True), 0.25)
    return points - np.clip(step, -0.03, 0.03)
