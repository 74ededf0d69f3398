# SPDX-License-Identifier: Apache-2.0
"""Which part of the body each garment vertex can meet.

The nearest body point does not know which side cloth came from: a sleeve that one bad step takes through the arm is
pushed out on the other side, and stays there. What is loose may meet any part of the body. What is tight lies over
one patch of it, as in the bind pose, and meets no other, so that it is always pushed back to its own side; nor is it
caught between two parts of a body that passes through itself, as in an armpit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..assets import PINNED, TIGHT, Floats, Ints, Mesh, Scene
from ..mesh import topology
from ..mesh.geodesic import edge_graph
from .body import faces_among
from .distance import FAR, Patches, PosedBody, nearest_planes, signed, smoothed_planes
from .nearest_vertex import BLOCK, compact_blocks
from .smoothed_distance import SmoothedDistance

EXTENT = 1 / 12  # radius of a patch along the body, as a share of the body's diagonal: half the girth of an upper arm
MOST = 256  # vertices of a patch; of a finer body the patch is smaller
SOURCES = 512  # vertices that distances along the body are found from at once
SAME_PLACE = 1e-6  # [m] that vertices at the same place are apart at most
NOWHERE = 1e6  # [m] from a plane that is met by nothing


@dataclass(frozen=True, eq=False)
class _Group:
    """Garment vertices `rows` that find the body in one way, with their blocks and what they may find."""

    rows: Tensor
    blocks: Tensor
    patches: Patches | None


class Contacts:
    """Finds the plane of the body that each vertex of a garment meets.

    Args:
        vertices: the body vertices that are posed, all by default.
        pinned: whether pinned vertices meet the body too. Nothing that is learned moves them.
    """

    def __init__(
        self, scene: Scene, *, vertices: Ints | None = None, pinned: bool = True, device: torch.device
    ) -> None:
        body, garment = scene.character.merged_body().mesh, scene.garment.mesh
        chosen = np.arange(body.vertex_count) if vertices is None else vertices
        tight = np.flatnonzero(scene.classes == TIGHT)
        patches = patches_beneath(garment.points[tight], body, chosen)
        covered = patches[:, 0] > 0
        elsewhere = np.ones(garment.vertex_count, dtype=bool) if pinned else scene.classes != PINNED
        elsewhere[tight[covered]] = False

        def tensor(values: Ints) -> Tensor:
            return torch.as_tensor(values, device=device)

        def group(rows: Ints, found: Patches | None = None) -> _Group:
            return _Group(tensor(rows), tensor(compact_blocks(garment.points[rows], BLOCK)), found)

        self._groups = [group(np.flatnonzero(elsewhere))] if elsewhere.any() else []
        if covered.any():
            vertices = patches[covered]
            faces = faces_around(vertices, faces_among(body, chosen), len(chosen))
            self._groups.append(group(tight[covered], Patches(tensor(vertices.astype(np.int32)), tensor(faces))))

    def planes(self, x: Tensor, body: PosedBody) -> tuple[Tensor, Tensor]:
        """Return unit normals (V, 3, N) and offsets (V, N) of the planes that x (V, 3, N) meets, without gradients.

        Planes of vertices that meet nothing are far below them.
        """
        normal, offset = self._of_groups(x, body, nearest_planes, no_planes)
        return normal, offset

    def smoothed(self, x: Tensor, body: PosedBody) -> SmoothedDistance:
        """Return smoothed distances of x (V, 3, N) to what it meets, as `planes` does, in the precision of x."""

        def find(*asked: Any) -> Sequence[Tensor]:
            return smoothed_planes(*asked).tensors()

        def nothing(x: Tensor) -> Sequence[Tensor]:
            return *no_planes(x), x.new_zeros(len(x), 3, *x.shape[1:], dtype=torch.float32)

        return SmoothedDistance(*self._of_groups(x, body, find, nothing))

    def _of_groups(
        self,
        x: Tensor,
        body: PosedBody,
        find: Callable[..., Sequence[Tensor]],
        nothing: Callable[[Tensor], Sequence[Tensor]],
    ) -> Sequence[Tensor]:
        """Return what each group finds, with `nothing` for vertices that are in none; vertices first in all of it."""
        if len(self._groups) == 1 and len(self._groups[0].rows) == len(x):
            return find(x, body, self._groups[0].blocks, self._groups[0].patches)
        gathered = nothing(x)
        for group in self._groups:
            found = find(x.index_select(0, group.rows), body, group.blocks, group.patches)
            for whole, part in zip(gathered, found, strict=True):
                whole.index_copy_(0, group.rows, part)
        return gathered

    def distances(self, x: Tensor, body: PosedBody) -> tuple[Tensor, Tensor]:
        """Return signed distances of x (V, 3, N) [m] to these planes and to the whole body, both (V, N)."""
        met = signed(x, *self.planes(x, body))
        nearest = met.clone()
        for group in self._groups:
            if group.patches is not None:
                part = x.index_select(0, group.rows)
                nearest.index_copy_(0, group.rows, signed(part, *nearest_planes(part, body, group.blocks)))
        return met, nearest


def no_planes(x: Tensor) -> tuple[Tensor, Tensor]:
    """Return planes that no vertex of x (V, 3, N) meets."""
    return x.new_zeros(x.shape), x.new_full((len(x), x.shape[2]), -NOWHERE)


def patches_beneath(points: Floats, body: Mesh, chosen: Ints) -> Ints:
    """Return the patch of a body that each of some points (T, 3) lies over, in the bind pose.

    A patch is what lies within `EXTENT` along the body's edges of the vertex nearest to the point, and faces the
    same half of space. Vertices at the same place count as joined: bodies are split at seams, or come in parts.

    Returns:
        How many vertices follow, then these as indices into `chosen`, the nearest first, filled up with it,
        shape (T, 1 + C); no vertices for a point that lies over nothing.
    """
    from scipy.spatial import cKDTree

    if not len(points) or not len(chosen):
        return np.zeros((len(points), 2), dtype=np.int64)
    distance, nearest = cKDTree(body.points[chosen]).query(points)
    anchors, which = np.unique(nearest, return_inverse=True)
    patches = _patches(body, chosen, anchors)[which]
    patches[distance > FAR, 0] = 0
    return patches


def _patches(body: Mesh, chosen: Ints, anchors: Ints) -> Ints:
    """Return the patch around each of the vertices `chosen[anchors]`, as `patches_beneath` does, (A, 1 + C)."""
    from scipy.sparse.csgraph import dijkstra
    from scipy.spatial import cKDTree

    joined = cKDTree(body.points).query_pairs(SAME_PLACE, output_type="ndarray")
    pairs = np.unique(np.concatenate([topology.edges(body.faces), joined]), axis=0)
    graph = edge_graph(body.points, pairs)
    normals = topology.vertex_normals(body.points, body.faces)[chosen]
    extent = EXTENT * float(np.linalg.norm(np.ptp(body.points, axis=0)))
    patches = []
    for start in range(0, len(anchors), SOURCES):
        part = anchors[start : start + SOURCES]
        along = dijkstra(graph, directed=False, indices=chosen[part], limit=extent)[:, chosen]
        along[normals[part] @ normals.T <= 0] = np.inf
        along[np.arange(len(part)), part] = 0
        order = np.argsort(along, axis=1, kind="stable")[:, :MOST]
        within = np.isfinite(np.take_along_axis(along, order, axis=1))
        patches.append(np.column_stack([within.sum(axis=1), np.where(within, order, order[:, :1])]))
    found = np.concatenate(patches)
    return found[:, : 1 + found[:, 0].max()]


def faces_around(patches: Ints, faces: Ints, count: int) -> Ints:
    """Return the faces with a corner in each patch (T, 1 + C) of `count` vertices, filled up by -1, shape (T, L)."""
    owner = np.repeat(np.arange(len(faces)), 3)[np.argsort(faces.reshape(-1), kind="stable")]
    ends = np.cumsum(np.bincount(faces.reshape(-1), minlength=count))
    around = np.split(owner, ends[:-1])
    kinds, which = np.unique(patches, axis=0, return_inverse=True)
    found = [np.unique(np.concatenate([around[vertex] for vertex in row[:size]])) for size, *row in kinds.tolist()]
    table = np.full((len(found), max(1, *map(len, found))), -1)
    for row, own in zip(table, found):
        row[: len(own)] = own
    return table[which.reshape(-1)]
