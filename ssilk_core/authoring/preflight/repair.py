# SPDX-License-Identifier: Apache-2.0
"""Plan safe repairs of a garment as index maps, so that all per-vertex and per-corner data can follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...events import format_count
from ...scene.assets import Character, Floats, Garment, Ints, Mesh, ProxyRig
from ...scene.mesh.topology import SAME_PLACE, border_vertices, edge_use, edges
from .fit import describe_left, describe_move
from .mesh import distinct_faces
from .settle import settle
from .winding import outward_flips

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class MeshRepair:
    """A repaired mesh in terms of the original one.

    Attributes:
        kept: original vertex of each new one, shape (V',).
        new_index: new vertex of each original one, -1 for removed ones, shape (V,).
        polygons: original polygon of each new one, shape (P',).
        corners: original corner of each new one, shape (sum of counts,).
        counts: number of corners of each new polygon, shape (P',).
        flipped: whether the winding of each new polygon is reversed, shape (P',).
        offsets: displacements of the new vertices [m], shape (V', 3).
        done: descriptions of the repairs.
        reshapes: whether vertices and faces may change, instead of only positions.
    """

    kept: Ints
    new_index: Ints
    polygons: Ints
    corners: Ints
    counts: Ints
    flipped: Mask
    offsets: Floats
    done: tuple[str, ...]
    reshapes: bool = True


def plan_repair(
    character: Character,
    garment: Garment,
    rig: ProxyRig | None,
    *,
    topology: bool = True,
    inner: Sequence[Mesh] = (),
) -> MeshRepair:
    """Plan all safe repairs of a garment.

    Coincident vertices with the same class and weights are merged. Faces that collapse as a result, duplicate faces
    and isolated vertices are removed. Winding becomes consistent and faces away from the body. Cloth in the body is
    settled out of it, and off inner garments (`settle`).

    Args:
        rig: proxies authored for the garment; merged vertices must agree in these weights, too.
        topology: whether vertices and faces may change; if not, vertices only move.
        inner: the garments that it is worn over, in the bind pose.
    """
    mesh, body = garment.mesh, character.merged_body().mesh
    settled = settle(mesh, body, inner=inner)
    offsets, left = settled.offsets, describe_left(settled, mesh, character)
    moved = (*([describe_move(settled, "moved")] if settled.moved else []), *([left] if left else []))
    if not topology:
        return _moved_only(mesh, offsets, moved)
    target = merge_targets(garment, rig, character)
    polygons, corners, counts = _kept_polygons(mesh, target)
    vertices = target[mesh.indices_of_corners[corners]]
    flipped = outward_flips(mesh.points, counts, vertices, body)
    kept = np.unique(vertices)
    new_index = np.full(mesh.vertex_count, -1)
    new_index[kept] = np.arange(len(kept))
    merged = int(np.count_nonzero(target != np.arange(len(target))))
    done = _told({
        ("vertices", "merged into others"): merged,
        ("isolated vertices", "removed"): mesh.vertex_count - len(kept) - merged,
        ("faces", "removed"): len(_counts(mesh)) - len(polygons), ("faces", "flipped"): int(flipped.sum()),
    })  # fmt: skip
    order = _flipped_order(counts, flipped)
    return MeshRepair(kept, new_index[target], polygons, corners[order], counts, flipped, offsets[kept], done + moved)


def _moved_only(mesh: Mesh, offsets: Floats, done: tuple[str, ...]) -> MeshRepair:
    every, counts = np.arange(mesh.vertex_count), _counts(mesh)
    corners, flipped = np.arange(counts.sum()), np.zeros(len(counts), dtype=bool)
    return MeshRepair(every, every, np.arange(len(counts)), corners, counts, flipped, offsets, done, reshapes=False)


def _counts(mesh: Mesh) -> Ints:
    assert mesh.polygon_counts is not None  # filled in by Mesh
    return mesh.polygon_counts.astype(np.int64)


def merge_targets(garment: Garment, rig: ProxyRig | None, character: Character) -> Ints:
    """Return the vertex that each one merges into, usually itself, shape (V,).

    Vertices merge if they agree in position, class and weights and lie at the borders of panels or on an edge of
    zero length. They do not merge if an edge would then have more than two faces, so touching layers stay separate.
    """
    mesh = garment.mesh
    same = _alike(garment, rig, character)
    pairs = edges(mesh.faces)
    joinable = border_vertices(mesh.faces, mesh.vertex_count)
    joinable[pairs[same[pairs[:, 0]] == same[pairs[:, 1]]]] = True
    while True:
        own = np.where(joinable, same, same.max() + 1 + np.arange(len(same)))
        _, first, group = np.unique(own, return_index=True, return_inverse=True)
        target = first[group.reshape(-1)]
        crowded = _crowded(mesh.faces, target) & joinable
        if not (crowded & (np.bincount(target, minlength=len(target))[target] > 1)).any():
            return target
        joinable &= ~crowded


def _alike(garment: Garment, rig: ProxyRig | None, character: Character) -> Ints:
    """Return a label for each vertex, equal where position, class and weights are equal, shape (V,)."""
    joints = character.skeleton.joint_count
    columns = [np.round(garment.mesh.points / SAME_PLACE)]
    if garment.classes is not None:
        columns.append(garment.classes[:, None].astype(float))
    if garment.skin is not None:
        columns.append(garment.skin.dense(joints).round(5))
    if rig is not None:
        columns.append(rig.skin.dense(joints + rig.proxy_count).round(5))
    return np.unique(np.concatenate(columns, axis=1), axis=0, return_inverse=True)[1].reshape(-1)


def _crowded(faces: Ints, target: Ints) -> Mask:
    """Return the vertices on edges that merging would make non-manifold, or more so than before, shape (V,)."""
    pairs, uses = edge_use(distinct_faces(target[faces]))
    worst = max(2, int(edge_use(distinct_faces(faces))[1].max()))
    return np.isin(target, pairs[uses > worst])


def _kept_polygons(mesh: Mesh, target: Ints) -> tuple[Ints, Ints, Ints]:
    """Return the polygons, corners and counts that remain when vertices merge into `target` (V,)."""
    counts, vertices = _counts(mesh), target[mesh.indices_of_corners]
    every, corners = np.arange(len(counts)), np.arange(len(vertices))
    owner = np.repeat(every, counts)
    before = corners - 1
    before[np.cumsum(counts) - counts] += counts
    stays = vertices != vertices[before]
    left = np.bincount(owner, stays, minlength=len(counts)).astype(np.int64)
    whole = (left >= 3) & _first_of_kind(owner[stays], vertices[stays], len(counts))
    stays &= whole[owner]
    return every[whole], corners[stays], left[whole]


def _first_of_kind(owner: Ints, vertices: Ints, count: int) -> Mask:
    """Return which polygons are the first with their set of vertices, shape (count,)."""
    order = np.lexsort((vertices, owner))
    groups = np.split(vertices[order], np.cumsum(np.bincount(owner, minlength=count))[:-1])
    seen: set[bytes] = set()
    first = np.zeros(count, dtype=bool)
    for number, group in enumerate(groups):
        key = group.tobytes()
        first[number] = key not in seen
        seen.add(key)
    return first


def _flipped_order(counts: Ints, flips: Mask) -> Ints:
    """Return the order of corners that reverses the polygons in `flips` (P,)."""
    start = np.repeat(np.cumsum(counts) - counts, counts)
    last = np.repeat(np.cumsum(counts) - 1, counts)
    position = np.arange(len(start))
    return np.where(np.repeat(flips, counts), last - (position - start), position)


def _told(counts: dict[tuple[str, str], int]) -> tuple[str, ...]:
    return tuple(f"{format_count(count, elements)} {what}" for (elements, what), count in counts.items() if count)
