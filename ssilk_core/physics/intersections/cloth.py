# SPDX-License-Identifier: Apache-2.0
"""Which triangles of a garment intersect others of it, frame by frame.

A pair of triangles does not count where it intersects in the bind pose, and where a stitch joins it: the triangles
around a stitched vertex, with those around the face that it lies on. So buttons, pockets and overlapping panels count
where they pass through other cloth, and a garment at rest has none. Vertices that seams doubled (they coincide in the
bind pose) are one where they lie within `TOGETHER` of each other, so that their triangles are neighbours; a slit that
opens has borders of its own.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...scene.assets import Floats, Ints, Mesh, Scene
from ...scene.mesh.stitches import find_stitches
from ...scene.mesh.topology import merged_places
from .figures import SelfIntersections
from .pairs import self_intersections

TOGETHER = 1e-3  # [m] between vertices of a seam that is closed; stitches hold them within less
NAMED_REGIONS = 3


@dataclass(frozen=True, eq=False)
class IntersectionCounts:
    """How much of a garment intersects itself in frames of one clip.

    Attributes:
        shares: share of its triangles in each frame, shape (N,).
        triangles: frames in which each triangle intersects others, shape (F,).
        frames: numbers of the frames in the clip, or their time codes, shape (N,).
    """

    shares: Floats
    triangles: Ints
    frames: Floats

    @classmethod
    def joined(cls, parts: Sequence[IntersectionCounts]) -> IntersectionCounts:
        """Return the counts of several parts together."""
        return cls(
            np.concatenate([part.shares for part in parts]),
            np.sum([part.triangles for part in parts], axis=0),
            np.concatenate([part.frames for part in parts]),
        )


class ClothIntersections:
    """The triangles of a garment, and the pairs of them that may intersect.

    Attributes:
        mesh: the garment in the bind pose.
        regions: the joint with the largest weight at each triangle in linear blend skinning, shape (F,); None where
            that is not known.
        joint_names: names of the character's joints.
    """

    def __init__(self, mesh: Mesh, regions: Ints | None = None, joint_names: Sequence[str] = ()) -> None:
        self.mesh, self.regions, self.joint_names = mesh, regions, joint_names
        self._first = _first_places(self.mesh.points)
        self._is_doubled = bool((self._first != np.arange(self.mesh.vertex_count)).any())
        allowed = [self._keys(self._pairs(self.mesh.points)), self._keys(_stitched_pairs(self.mesh))]
        self.allowed = np.unique(np.concatenate(allowed))

    @classmethod
    def of(cls, scene: Scene) -> ClothIntersections:
        """Return those of the garment of a scene, by the joints of its character."""
        mesh, names = scene.garment.mesh, scene.character.skeleton.joint_names
        return cls(mesh, scene.lbs_skin.dense(len(names))[mesh.faces].sum(axis=1).argmax(axis=1), names)

    def pairs(self, points: Floats) -> NDArray[np.int64]:
        """Return the pairs of triangles that count in a frame, shape (P, 2).

        Args:
            points: finite positions of the garment's vertices [m], shape (V, 3).
        """
        found = self._pairs(points)
        return found[~np.isin(self._keys(found), self.allowed)]

    def triangles(self, points: Floats) -> NDArray[np.bool_]:
        """Return which triangles intersect others in a frame, shape (F,): all where it is not finite.

        Args:
            points: as `pairs` takes them.
        """
        if not np.isfinite(points).all():
            return np.ones(len(self.mesh.faces), dtype=bool)
        found = np.zeros(len(self.mesh.faces), dtype=bool)
        found[self.pairs(points)] = True
        return found

    def counts(self, frames: Sequence[Floats], numbers: Sequence[float]) -> IntersectionCounts:
        """Return the counts of frames (V, 3) [m], which have these numbers in their clip."""
        found = np.array([self.triangles(points) for points in frames]).reshape(-1, len(self.mesh.faces))
        return IntersectionCounts(found.mean(axis=1), found.sum(axis=0), np.asarray(numbers, dtype=np.float64))

    def figures(self, clips: Sequence[tuple[str, IntersectionCounts]]) -> SelfIntersections:
        """Return the figures of clips by name.

        Raises:
            ValueError: there is no frame.
        """
        triangles = IntersectionCounts.joined([counts for _, counts in clips]).triangles
        return SelfIntersections.over(clips, len(self.mesh.faces), regions=self._regions(triangles))

    def _regions(self, triangles: Ints) -> dict[str, float]:
        """Return the shares of what intersects at the joints with the largest ones."""
        if self.regions is None:
            return {}
        found = np.bincount(self.regions, triangles, len(self.joint_names))
        largest = Counter(dict(enumerate(found.tolist()))).most_common(NAMED_REGIONS)
        return {self.joint_names[joint].rpartition("/")[2]: n / float(found.sum()) for joint, n in largest if n}

    def _pairs(self, points: Floats) -> NDArray[np.int64]:
        faces = self.mesh.faces
        if self._is_doubled:
            near = np.linalg.norm(points - points[self._first], axis=1) < TOGETHER
            faces = np.where(near, self._first, np.arange(len(points)))[faces]
        return self_intersections(points, faces)

    def _keys(self, pairs: Ints) -> NDArray[np.int64]:
        """Return one integer for each pair (P, 2) in ascending order."""
        return pairs[:, 0] * len(self.mesh.faces) + pairs[:, 1]


def _first_places(points: Floats) -> NDArray[np.int64]:
    """Return the first of the vertices that coincide with each, shape (V,)."""
    place = merged_places(points)
    return np.unique(place, return_index=True)[1][place]


def _stitched_pairs(mesh: Mesh) -> NDArray[np.int64]:
    """Return the pairs of triangles that stitches join, each in ascending order, shape (P, 2)."""
    stitches = find_stitches(mesh)
    around: dict[int, list[int]] = {vertex: [] for vertex in np.unique([*stitches.vertices, *stitches.corners.flat])}
    for face, corners in enumerate(mesh.faces.tolist()):
        for vertex in corners:
            if vertex in around:
                around[vertex].append(face)
    joined = {
        (min(own, other), max(own, other))
        for vertex, corners in zip(stitches.vertices.tolist(), stitches.corners.tolist())
        for own in around[vertex]
        for corner in corners
        for other in around[corner]
    }
    return np.array(sorted(joined), dtype=np.int64).reshape(-1, 2)
