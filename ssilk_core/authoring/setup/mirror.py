# SPDX-License-Identifier: Apache-2.0
"""The two sides of a symmetric garment, so that its proxies are mirror images and named as such.

Only what is symmetric to rounding counts, as a mirror modifier leaves it: cloth that was draped or fitted has no
vertices that are images of others.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...scene.assets import Floats, Ints, Mesh
from ...scene.mesh.geodesic import distances
from ...scene.mesh.topology import edges

SAME = 1e-5  # [m] between a vertex and the image of its twin
LEFT, RIGHT = "_L", "_R"  # USD has no dots in names; Blender flips these too
_LEFT_NAME, _RIGHT_NAME = (re.compile(rf"{word}|(^|[._\- ]){word[0]}($|[._\- ])", re.I) for word in ("left", "right"))


@dataclass(frozen=True, eq=False)
class Mirror:
    """A plane that mirrors a garment onto itself.

    Attributes:
        axis: of the core's axes, that the plane is across.
        centre: where the plane is on it [m].
        twin: of each vertex, the one that is its image: itself in the plane, shape (V,).
    """

    axis: int
    centre: float
    twin: Ints

    def image(self, transforms: Floats) -> Floats:
        """Return proper rotations and places (..., 4, 4) whose y and z axes and places are the images of others'."""
        flip = np.ones(3)
        flip[self.axis] = -1
        result = np.array(transforms)
        result[..., :3, 1:4] *= flip[:, None]
        result[..., :3, 0] = np.cross(result[..., :3, 1], result[..., :3, 2])
        result[..., self.axis, 3] += 2 * self.centre
        return result

    def sides(self, places: Floats, joint_names: Sequence[str], joints: Floats) -> list[str]:
        """Return `LEFT` or `RIGHT` for each of some places (N, 3), as the character's joints (J, 3) are named."""
        along = joints[:, self.axis] - self.centre
        leaves = [name.rpartition("/")[2] for name in joint_names]
        towards = sum(along[i] * (bool(_LEFT_NAME.search(leaf)) - bool(_RIGHT_NAME.search(leaf)))
                      for i, leaf in enumerate(leaves))  # fmt: skip
        facing_forward = 1 if self.axis == 0 else -1  # along z or x, where no name tells
        left = np.sign(towards) or facing_forward
        return [LEFT if (place - self.centre) * left > 0 else RIGHT for place in places[:, self.axis]]


def find_mirror(mesh: Mesh, loose: NDArray[np.bool_]) -> Mirror | None:
    """Return the upright plane that mirrors a mesh and what of it is `loose` (V,); None where it has none."""
    from scipy.spatial import cKDTree

    points, numbers = np.asarray(mesh.points), np.arange(mesh.vertex_count)
    sides = _sides(mesh)
    for axis in (0, 2):
        centre = (points[:, axis].min() + points[:, axis].max()) / 2
        image = points.copy()
        image[:, axis] = 2 * centre - image[:, axis]
        away, twin = cKDTree(points).query(image)
        if not (away.max() < SAME and (twin[twin] == numbers).all() and (loose[twin] == loose).all()):
            continue
        if np.array_equal(sides, np.unique(np.sort(twin[sides], axis=1), axis=0)):
            return Mirror(axis, float(centre), twin)
    return None


def mirrored_points(
    points: Floats, faces: Ints, twin: Ints, first: Floats, count: int, placed: Callable[[], object]
) -> tuple[Ints, Floats]:
    """Sample vertices by farthest-point sampling, in pairs of twins and in the plane.

    Args:
        first: where to begin: the vertex with the lowest value, one in the plane if any has a finite one, shape (V,).
        count: how many are wanted; one fewer is sampled where the last has no place in the plane.
        placed: called after each sample.

    Returns:
        The samples, shape (S,), and the distance of every vertex to each of them [m], shape (S, V).
    """
    numbers = np.arange(len(points))
    pairs, within = edges(faces), twin == numbers
    crossing = np.unique(pairs[twin[pairs[:, 0]] == pairs[:, 1]])
    to_plane = distances(points, faces, np.union1d(np.flatnonzero(within), crossing))
    samples: list[int] = []
    rows: list[Floats] = []

    def add(vertex: int) -> None:
        row = distances(points, faces, np.array([vertex]))
        both = [(vertex, (row + row[twin]) / 2)] if within[vertex] else [(vertex, row), (int(twin[vertex]), row[twin])]
        for sample, distance in both:
            samples.append(sample)
            rows.append(distance)
            placed()

    begin = np.where(within, first, np.inf)
    add(int((begin if np.isfinite(begin).any() else first).argmin()))
    while len(samples) < count:
        nearest = np.min(rows, axis=0)
        gain = np.where(within, nearest, np.minimum(nearest, 2 * to_plane))
        gain[~np.isfinite(gain) | (~within & (count - len(samples) < 2))] = 0
        if gain.max() <= 0:
            break
        add(int(gain.argmax()))
    return np.array(samples), np.array(rows)


def mates_of(samples: Ints, twin: Ints) -> Ints:
    """Return the index of each sample's twin among samples (S,), -1 for none, shape (S,)."""
    place = {sample: index for index, sample in enumerate(samples.tolist())}
    return np.array([place.get(int(twin[sample]), -1) for sample in samples], dtype=np.int64)


def _sides(mesh: Mesh) -> Ints:
    """Return the sides of a mesh's polygons, each once as an ascending pair of vertices, in order, shape (E, 2).

    Triangles may divide two polygons that are images along different diagonals.
    """
    counts, corners = np.asarray(mesh.polygon_counts), np.asarray(mesh.indices_of_corners)
    following = np.arange(1, len(corners) + 1)
    ends = np.cumsum(counts)
    following[ends - 1] = ends - counts
    return np.unique(np.sort(np.stack([corners, corners[following]], axis=1), axis=1), axis=0)
