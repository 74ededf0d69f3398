# SPDX-License-Identifier: Apache-2.0
"""The part of the body that each sample of the cloth can touch.

The nearest body point does not tell which side the cloth came from. A sleeve that one bad step takes through the arm
would be pushed out on the far side and stay there. Loose cloth can touch any part of the body. Tight cloth can touch
only the patch of the body that lies beneath it in the bind pose, within `distance.TIGHT_REACH`: it is pushed back to
its own side, and is not caught where a body intersects itself, as in an armpit. Loose cloth that a limb went through
is pushed along the limb instead (`pierced`).
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
from ..mesh.blocks import compact_blocks
from ..mesh.geodesic import edge_graph
from .distance import (
    MAX_QUERY_DISTANCE,
    Patches,
    PosedBody,
    nearest_planes,
    signed_distance_to_planes,
    smoothed_planes,
)
from .limb_axes import loose_faces
from .nearest_vertex import GARMENT_BLOCK
from .pierced import Piercing
from .samples import ContactSamples
from .smoothed_distance import SmoothedDistance

PATCH_RADIUS = 1 / 12  # geodesic, relative to the diagonal of the body's bounding box: half the girth of an upper arm
MAX_PATCH_VERTICES = 256  # on a finer body the patch is smaller than its radius
SOURCES_PER_BATCH = 512  # of geodesic distances
COINCIDENT_DISTANCE = 1e-6  # [m]
NO_CONTACT_DISTANCE = 1e6  # [m]


@dataclass(frozen=True, eq=False)
class _Group:
    """Samples that query the body in the same way: their indices, compact blocks and body patches."""

    rows: Tensor
    blocks: Tensor
    patches: Patches | None


class Contacts:
    """Finds the tangent plane of the body that each sample of the cloth can touch.

    Args:
        samples: of the garment, which are queried; S positions are expected.
        vertices: the body vertices that are posed, all by default.
        pinned: whether pinned cloth collides too. Training, which cannot move them, leaves them out.
    """

    def __init__(
        self,
        scene: Scene,
        samples: ContactSamples,
        *,
        vertices: Ints | None = None,
        pinned: bool = True,
        device: torch.device,
    ) -> None:
        body = scene.character.merged_body().mesh
        points, classes = samples.points(scene.garment.mesh.points), samples.classes(scene.classes)
        chosen = np.arange(body.vertex_count) if vertices is None else vertices
        tight = np.flatnonzero(classes == TIGHT)
        patches = patches_beneath(points[tight], body, chosen)
        covered = patches[:, 0] > 0
        elsewhere = np.ones(len(points), dtype=bool) if pinned else classes != PINNED
        elsewhere[tight[covered]] = False

        def tensor(values: Ints) -> Tensor:
            return torch.as_tensor(values, device=device)

        def group(rows: Ints, found: Patches | None = None) -> _Group:
            return _Group(tensor(rows), tensor(compact_blocks(points[rows], GARMENT_BLOCK)), found)

        self._piercing = Piercing(scene, samples, device=device) if len(loose_faces(scene)) else None
        self._groups = [group(np.flatnonzero(elsewhere))] if elsewhere.any() else []
        if covered.any():
            vertices = patches[covered]
            faces = faces_around(vertices, topology.faces_among(body, chosen), len(chosen))
            self._groups.append(group(tight[covered], Patches(tensor(vertices.astype(np.int32)), tensor(faces))))

    def planes(self, x: Tensor, body: PosedBody) -> tuple[Tensor, Tensor]:
        """Return unit normals (S, 3, N) and offsets (S, N) of the planes that x (S, 3, N) can touch, without
        gradients.

        Samples that can touch nothing get planes far below them. Those far from their patch get planes across the
        direction from its nearest vertex.
        """
        normal, offset = self._nearest_planes(x, body)
        if self._piercing and body.limbs:
            self._piercing.replace_planes(x, body.limbs, normal, offset)
        return normal, offset

    def _nearest_planes(self, x: Tensor, body: PosedBody) -> tuple[Tensor, Tensor]:
        """Return the result of `planes` where no limb pierces the cloth."""
        normal, offset = self._query_groups(x, body, nearest_planes, no_planes)
        return normal, offset

    def smoothed(self, x: Tensor, body: PosedBody) -> SmoothedDistance:
        """Return smoothed distances of x (S, 3, N) to the body, in the precision of x."""

        def find(*asked: Any) -> Sequence[Tensor]:
            return smoothed_planes(*asked).tensors()

        def no_contact(x: Tensor) -> Sequence[Tensor]:
            return *no_planes(x), x.new_zeros(len(x), 3, *x.shape[1:], dtype=torch.float32)

        found = SmoothedDistance(*self._query_groups(x, body, find, no_contact))
        if self._piercing and body.limbs:
            self._piercing.replace_planes(x, body.limbs, found.normal, found.offset, found.curvature)
        return found

    def _query_groups(
        self,
        x: Tensor,
        body: PosedBody,
        find: Callable[..., Sequence[Tensor]],
        no_contact: Callable[[Tensor], Sequence[Tensor]],
    ) -> Sequence[Tensor]:
        """Return the results of `find` for all groups, and of `no_contact` for other samples.

        Samples come first.
        """
        if len(self._groups) == 1 and len(self._groups[0].rows) == len(x):
            return find(x, body, self._groups[0].blocks, self._groups[0].patches)
        gathered = no_contact(x)
        for group in self._groups:
            found = find(x.index_select(0, group.rows), body, group.blocks, group.patches)
            for full, part in zip(gathered, found, strict=True):
                full.index_copy_(0, group.rows, part)
        return gathered

    def distances(self, x: Tensor, body: PosedBody) -> tuple[Tensor, Tensor]:
        """Return signed distances of x (S, 3, N) [m] to nearest planes and to the whole body, both (S, N).

        Where a limb pierces the cloth they are those to the skin: `CoveredSkin` counts such limbs.
        """
        planes = signed_distance_to_planes(x, *self._nearest_planes(x, body))
        nearest = planes.clone()
        for group in self._groups:
            if group.patches is not None:
                part = x.index_select(0, group.rows)
                nearest.index_copy_(
                    0, group.rows, signed_distance_to_planes(part, *nearest_planes(part, body, group.blocks))
                )
        return planes, nearest


def no_planes(x: Tensor) -> tuple[Tensor, Tensor]:
    """Return planes that no sample of x (S, 3, N) touches."""
    return x.new_zeros(x.shape), x.new_full((len(x), x.shape[2]), -NO_CONTACT_DISTANCE)


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
