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
from ...scene.mesh.geodesic import Measure
from ...scene.mesh.topology import edge_use, edges

SAME = 1e-5  # [m] between a vertex and the image of its twin
LEFT, RIGHT = "_L", "_R"  # USD has no dots in names; Blender flips these too
# "left_arm", "LeftArm", "arm.L", "l_arm" and "LArm", but neither "cleft" nor "Lip".
_LEFT_NAME, _RIGHT_NAME = (
    re.compile(rf"(?<![A-Za-z]){low}|{low.title()}|(^|[._\- ])[{low[0]}{low[0].upper()}]($|[._\- ]|(?=[A-Z][a-z]))")
    for low in ("left", "right")
)


@dataclass(frozen=True, eq=False)
class Mirror:
    """A plane that mirrors a garment onto itself.

    Attributes:
        axis: of the core's axes, that the plane is across.
        centre: where the plane is on it [m].
        twin: of each vertex, the one that is its image: itself in the plane; of one that is carried, that of its
            host, shape (V,).
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


def find_mirror(mesh: Mesh, pieces: Ints, hosts: Ints) -> Mirror | None:
    """Return the upright plane that mirrors the points, the borders and the pieces of a mesh; None without one.

    Its polygons need not be images: programs divide them along either diagonal. Nor need what the cloth carries,
    such as buttons.

    Args:
        pieces: number of the loose piece that each vertex belongs to, -1 for the others, shape (V,).
        hosts: vertex that carries each, itself without one, shape (V,).
    """
    from scipy.spatial import cKDTree

    numbers = np.arange(mesh.vertex_count)
    kept = np.flatnonzero(hosts == numbers)
    points, borders = mesh.points[kept], _borders(mesh, hosts == numbers)
    for axis in (0, 2):
        centre = (points[:, axis].min() + points[:, axis].max()) / 2
        image = points.copy()
        image[:, axis] = 2 * centre - image[:, axis]
        away, nearest = cKDTree(points).query(image)
        if not (away.max() < SAME and (nearest[nearest] == np.arange(len(kept))).all()):
            continue
        twin = numbers.copy()
        twin[kept] = kept[nearest]
        twin = twin[hosts]
        of_pieces = np.unique(np.stack([pieces, pieces[twin]], axis=1), axis=0)
        one_to_one = len(of_pieces) == len(np.unique(pieces)) and np.array_equal(pieces < 0, pieces[twin] < 0)
        if one_to_one and np.array_equal(borders, _in_order(twin[borders])):
            return Mirror(axis, float(centre), twin)
    return None


def mirrored_points(
    points: Floats,
    faces: Ints,
    twin: Ints,
    first: Floats,
    count: int,
    measure: Measure,
    placed: Callable[[], object],
) -> tuple[Ints, Floats]:
    """Sample vertices by farthest-point sampling, in pairs of twins and in the plane.

    Args:
        first: where to begin: the vertex with the lowest value, one in the plane if any has a finite one, shape (V,).
        count: how many are wanted; one fewer is sampled where the last has no place in the plane.
        measure: of the distance of vertices to sources.
        placed: called after each sample.

    Returns:
        The samples, shape (S,), and the distance of every vertex to each of them [m], shape (S, V).
    """
    numbers = np.arange(len(points))
    pairs, within, paired = edges(faces), twin == numbers, twin[twin] == numbers
    crossing = np.unique(pairs[twin[pairs[:, 0]] == pairs[:, 1]])
    to_plane = measure(points, faces, np.union1d(np.flatnonzero(within), crossing))
    samples: list[int] = []
    rows: list[Floats] = []

    def add(vertex: int) -> None:
        row = measure(points, faces, np.array([vertex]))
        both = (
            [(vertex, (row + row[twin]) / 2)] if within[vertex] else [(vertex, row), (int(twin[vertex]), row[twin])]
        )
        for sample, distance in both:
            samples.append(sample)
            rows.append(distance)
            placed()

    first = np.where(paired, first, np.inf)
    begin = np.where(within, first, np.inf)
    add(int((begin if np.isfinite(begin).any() else first).argmin()))
    while len(samples) < count:
        nearest = np.min(rows, axis=0)
        gain = np.where(within, nearest, np.minimum(nearest, 2 * to_plane))
        gain[~np.isfinite(gain) | ~paired | (~within & (count - len(samples) < 2))] = 0
        if gain.max() <= 0:
            break
        add(int(gain.argmax()))
    return np.array(samples), np.array(rows)


def mates_of(samples: Ints, twin: Ints) -> Ints:
    """Return the index of each sample's twin among samples (S,), -1 for none, shape (S,)."""
    place = {sample: index for index, sample in enumerate(samples.tolist())}
    return np.array([place.get(int(twin[sample]), -1) for sample in samples], dtype=np.int64)


def _borders(mesh: Mesh, kept: NDArray[np.bool_]) -> Ints:
    """Return the edges that one face alone has, of vertices that are `kept` (V,), as `_in_order` does."""
    pairs, used = edge_use(mesh.faces)
    return _in_order(pairs[(used == 1) & kept[pairs].all(axis=1)])


def _in_order(pairs: Ints) -> Ints:
    """Return pairs of vertices (E, 2), each ascending, in ascending order."""
    return np.unique(np.sort(pairs, axis=1), axis=0)
