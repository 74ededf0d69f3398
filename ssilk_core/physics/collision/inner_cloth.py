# SPDX-License-Identifier: Apache-2.0
"""Cloth beneath cloth: the surface of an inner garment as a collider that moves.

Each sample of the outer garment gets the plane at the nearest point of the inner surface, as it does of the body. The
side is that away from the body: neighbouring triangles of the inner garment are turned alike, to the side that faces
away from the nearest skin at rest, and those that clearly face the skin, as in a hood that lies on its back, are
turned over. Cloth has borders and is thin, other than a body:

- Beyond a hem there is nothing to come out of. Normals at a border lean outwards along the cloth, so that a sample
  past it is outside, in whatever height, and one straight beneath it is inside.
- A sample more than `DEEPEST` beneath the cloth is not moved: the far side of a limb or a fold may be nearer to it
  than the one that it has left.

Where a sample is near the body and several inner garments, what it lies deepest in counts alone: together they are
one obstacle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ...scene.assets import PINNED, TIGHT, Floats, Ints, Mesh, Scene
from ...scene.mesh import topology
from ...scene.mesh.blocks import compact_blocks
from .. import kernels
from ..framed import Framed
from ..operators import SparseOperator
from ..samples import ContactSamples
from .closest_point import triangle_patches
from .contacts import NO_CONTACT_DISTANCE, no_planes
from .distance import PosedBody, nearest_planes, signed_distance_to_planes, smoothed_planes
from .nearest_vertex import BODY_GROUP, GARMENT_BLOCK
from .smoothed_distance import SmoothedDistance

DEEPEST = 0.05  # [m] beneath inner cloth, up to which a sample is pushed out
FACING = (
    -0.5
)  # cosine between a triangle's normal and the direction away from the skin, below which it faces the skin
BORDER_NORMAL = 0.25  # share of the surface's normal in those at a border; the rest leans outwards along the cloth
Planes = tuple[Tensor, Tensor]


@dataclass(frozen=True, eq=False)
class InnerSurface:
    """A garment beneath another: its mesh in the bind pose, and the thickness of its fabric [m]."""

    mesh: Mesh
    thickness: float


@dataclass(frozen=True, eq=False)
class PosedBeneath(Framed):
    """The surfaces of several garments beneath one, in N frames."""

    parts: tuple[PosedBody, ...]


class InnerCloth:
    """An inner garment, and the samples of an outer one that can touch it; positions are (V, 3, N).

    Attributes:
        vertices: those of the inner garment that can be touched, shape (W,).
        rows: the samples that can touch them, shape (R,).

    Args:
        scene: of the outer garment.
        samples: of the outer garment; pinned ones do not collide, because nothing moves them.
        inner: the inner garment in the bind pose.
        thickness: of its fabric [m].
        touched: the vertices of the inner garment that the outer one can touch, bool (V,).
        touching: likewise those of the outer one, bool (U,).
    """

    def __init__(
        self,
        scene: Scene,
        samples: ContactSamples,
        inner: Mesh,
        thickness: float,
        touched: NDArray[np.bool_],
        touching: NDArray[np.bool_],
        *,
        device: torch.device,
    ) -> None:
        faces = turned_away(inner, scene.character.merged_body().mesh)
        faces = faces[touched[inner.faces].any(axis=1)]
        used = np.unique(faces)
        place = np.full(inner.vertex_count, -1)
        place[used] = np.arange(len(used))
        own, points = place[faces], inner.points[used]
        near = touching[samples.corners].any(axis=1) & (samples.classes(scene.classes) != PINNED)
        rows = np.flatnonzero(near) if len(faces) else np.zeros(0, dtype=np.int64)
        at = samples.points(scene.garment.mesh.points)[rows]

        def tensor(values: np.ndarray) -> Tensor:
            return torch.as_tensor(values, device=device)

        self.vertices, self.rows, self.half = tensor(used), tensor(rows), 0.5 * thickness
        self._faces, self._patches = tensor(own), tensor(triangle_patches(points, own))
        self._groups = tensor(compact_blocks(points, BODY_GROUP))
        self._blocks = tensor(compact_blocks(at, GARMENT_BLOCK))
        places = topology.merged_places(points)
        self._normals = _sums(places, own.reshape(-1), np.repeat(np.arange(len(own)), 3), len(own), device)
        half = topology.half_edges(own)
        _, edge, used = np.unique(topology.edge_keys(places[half]), return_inverse=True, return_counts=True)
        border = np.flatnonzero(used[edge] == 1)  # a half-edge runs with its triangle, which is to its left
        ends = half[border]
        self._border_faces, self._border_ends = tensor(border // 3), tensor(ends.T.copy())
        self._outwards = _sums(places, ends.reshape(-1), np.repeat(np.arange(len(ends)), 2), len(ends), device)
        self._bordered = tensor(np.isin(places, places[ends]))[:, None, None]

    def __len__(self) -> int:
        return len(self.rows)

    @torch.no_grad()
    def posed(self, y: Tensor) -> PosedBody:
        """Return the surface as a body, from positions of `vertices` y (W, 3, N)."""
        first, second, third = (y.index_select(0, corner) for corner in self._faces.T)
        normal = torch.linalg.cross(second - first, third - first, dim=1)
        unit = _unit(_sum(self._normals, normal))
        if len(self._border_faces):
            start, end = (y.index_select(0, ends) for ends in self._border_ends)
            along = torch.linalg.cross(end - start, _unit(normal.index_select(0, self._border_faces)), dim=1)
            out = _unit(_sum(self._outwards, along))
            unit = torch.where(self._bordered, _unit(BORDER_NORMAL * unit + out), unit)
        return PosedBody(y, unit, None, self._groups, self._faces, self._patches)

    @torch.no_grad()
    def planes(self, x: Tensor, y: Tensor) -> Planes:
        """Return normals (R, 3, N) and offsets (R, N) of planes half the inner thickness above the nearest points.

        Samples that touch nothing get planes far below them.

        Args:
            x: positions of the samples in `rows`, shape (R, 3, N).
            y: positions of the inner garment's `vertices`, shape (W, 3, N).
        """
        normal, offset = nearest_planes(x, self.posed(y), self._blocks)
        deep = signed_distance_to_planes(x, normal, offset) < -DEEPEST
        return normal, torch.where(deep, offset - NO_CONTACT_DISTANCE, offset + self.half)

    @torch.no_grad()
    def smoothed(self, x: Tensor, inner: PosedBody, within: float = math.inf) -> SmoothedDistance:
        """Return smoothed distances of x from the outer face of the cloth, in the precision of x.

        Where a sample touches nothing they are very large.

        Args:
            x: positions of the samples in `rows`, shape (R, 3, N).
            inner: the surface, as `posed` returns it.
            within: distances that matter outside of it [m] (`smoothed_planes`).
        """
        found = smoothed_planes(x, inner, self._blocks, within=within + self.half)
        deep = found.distance(x) < -DEEPEST
        offset = torch.where(deep, found.offset - NO_CONTACT_DISTANCE, found.offset + self.half)
        return SmoothedDistance(found.normal, offset, found.curvature.masked_fill(deep[:, None, None], 0))

    @torch.no_grad()
    def deeper(self, planes: Planes, x: Tensor, y: Tensor, worn: Tensor | None = None) -> Planes:
        """Return planes of all samples x (S, 3, N), replaced by those of this cloth where a sample is deeper in it.

        Args:
            planes: of what is beneath, such as the body: normals (S, 3, N) and offsets (S, N).
            y: positions of the inner garment's `vertices`, shape (W, 3, N).
            worn: whether the inner garment is there in each frame, bool (N,); always by default.
        """
        if not len(self):
            return planes
        own = x.index_select(0, self.rows)
        given = [values.index_select(0, self.rows) for values in planes]
        found = self.planes(own, y)
        nearer = signed_distance_to_planes(own, *found) < signed_distance_to_planes(own, *given)
        if worn is not None:
            nearer &= worn
        chosen = torch.where(nearer[:, None], found[0], given[0]), torch.where(nearer, found[1], given[1])
        normal, offset = (full.index_copy(0, self.rows, part) for full, part in zip(planes, chosen))
        return normal, offset

    @torch.no_grad()
    def contact_distance(self, x: Tensor, y: Tensor) -> Tensor:
        """Return the distance (S, N) [m] of samples x (S, 3, N) that contact with this cloth depends on.

        It is that from the outer face of the cloth, and very large for what touches nothing.
        """
        return signed_distance_to_planes(x, *self.deeper(no_planes(x), x, y))

    def distance(self, x: Tensor, y: Tensor) -> Tensor:
        """Return likewise the distance (S, N) [m] from the middle of the cloth, negative beneath it."""
        return self.contact_distance(x, y) + self.half


def loosened_over(scene: Scene, inner: Sequence[Scene]) -> Scene:
    """Return the scene of an outer garment that is tight where it was pinned over cloth that moves.

    Pinned cloth follows the body alone, and nothing moves it out of a hood or a sleeve that does not. It lies over a
    garment where it is at most `DEEPEST` from it in the bind pose. Over cloth that is pinned itself it stays pinned.

    Args:
        inner: of the garments beneath, on the same character.
    """
    pinned = np.flatnonzero(scene.classes == PINNED)
    if not len(pinned):
        return scene
    import igl

    classes = scene.classes.copy()
    points = np.ascontiguousarray(scene.garment.mesh.points[pinned])
    for each in inner:
        mesh = each.garment.mesh
        square, face, _ = igl.point_mesh_squared_distance(points, mesh.points, mesh.faces)
        moves = (each.classes[mesh.faces] != PINNED).any(axis=1)
        classes[pinned[(square < DEEPEST**2) & moves[face]]] = TIGHT
    if np.array_equal(classes, scene.classes):
        return scene
    return replace(scene, garment=replace(scene.garment, classes=classes))


def turned_away(inner: Mesh, body: Mesh) -> Ints:
    """Return the triangles of an inner garment, counter-clockwise as seen from outside the body, shape (F, 3)."""
    import igl

    place = topology.merged_places(inner.points)
    welded = place[inner.faces]
    whole = (welded != np.roll(welded, 1, axis=1)).all(axis=1)
    faces = inner.faces.copy()
    if not whole.any():
        return faces
    turned, part = igl.bfs_orient(np.ascontiguousarray(welded[whole]))
    part = np.unique(np.asarray(part).reshape(-1), return_inverse=True)[1]
    after = np.roll(turned, -1, axis=1)[turned == welded[whole][:, :1]]
    swapped = np.zeros(len(faces), dtype=bool)
    swapped[whole] = after != welded[whole][:, 1]
    faces[swapped] = faces[swapped][:, ::-1]
    corners = inner.points[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    away = _away_from(corners.mean(axis=1), body)
    along = (cross * away).sum(axis=1)
    inward = np.zeros(len(faces), dtype=bool)
    inward[whole] = (np.bincount(part, along[whole]) < 0)[part]
    cosine = np.where(inward, -1, 1) * along / np.maximum(np.linalg.norm(cross, axis=1), np.finfo(float).tiny)
    inward ^= cosine < FACING
    faces[inward] = faces[inward][:, ::-1]
    return faces


def _away_from(points: Floats, body: Mesh) -> Floats:
    """Return unit directions from the nearest points of a body to points (P, 3), negative inside of it, (P, 3)."""
    faces, groups = torch.tensor(body.faces), torch.as_tensor(compact_blocks(body.points, BODY_GROUP))
    normals = topology.vertex_normals(body.points, body.faces)
    patches = torch.as_tensor(triangle_patches(body.points, body.faces))

    def frame(values: Floats) -> Tensor:
        return torch.tensor(values, dtype=torch.float32)[:, :, None]

    posed = PosedBody(frame(body.points), frame(normals), None, groups, faces, patches)
    blocks = torch.as_tensor(compact_blocks(points, GARMENT_BLOCK))
    return nearest_planes(frame(points), posed, blocks)[0][:, :, 0].double().numpy()


def _sums(places: Ints, vertex: Ints, column: Ints, columns: int, device: torch.device) -> SparseOperator:
    """Return what sums columns (C, 3, N) at all vertices that coincide with one that each belongs to (W, 3, N)."""
    own, given = np.argsort(places, kind="stable"), places[vertex]
    first, last = (np.searchsorted(places[own], given, side) for side in ("left", "right"))
    count = last - first
    starts = np.repeat(first - np.concatenate([[0], np.cumsum(count)[:-1]]), count)
    rows, columns_of = own[starts + np.arange(count.sum())], np.repeat(column, count)
    pairs = np.unique(np.column_stack([rows, columns_of]), axis=0)
    values = np.ones(len(pairs))
    return SparseOperator(pairs[:, 0], pairs[:, 1], values, (len(places), columns), device, torch.float32)


def _sum(operator: SparseOperator, vectors: Tensor) -> Tensor:
    """Return the sums (W, 3, N) of vectors (C, 3, N)."""
    if not kernels.supports(vectors):
        return operator(vectors)
    from ..kernels.rows import rows_kernel

    return rows_kernel(vectors, operator.matrix, operator.transposed)


def _unit(vectors: Tensor) -> Tensor:
    """Return vectors (W, 3, N) of unit length; zero where they are shorter than any that mean something."""
    length = vectors.norm(dim=1, keepdim=True)
    return torch.where(length > 1e-12, vectors / length.clamp_min(1e-12), 0.0)
