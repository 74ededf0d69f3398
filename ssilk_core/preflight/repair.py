# SPDX-License-Identifier: Apache-2.0
"""What can be repaired on a garment without asking: planned as index maps, so that all data can follow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ssilk_core.assets import Character, Floats, Garment, Ints, Mesh, ProxyRig
from ssilk_core.mesh.topology import border_vertices, edge_use, edges

from .fit import MARGIN, push_out
from .mesh import SAME_PLACE
from .winding import outward_flips

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class MeshRepair:
    """A repaired mesh in terms of the old one.

    Attributes:
        kept: the old vertex of each new one, shape (V',).
        new_index: the new vertex of each old one, -1 for those removed, shape (V,).
        polygons: the old polygon of each new one, shape (P',).
        corners: the old corner of each new one, shape (sum of counts,).
        counts: corners of each new polygon, shape (P',).
        offsets: how far the new vertices move [m], shape (V', 3).
        done: what was repaired, in words.
    """

    kept: Ints
    new_index: Ints
    polygons: Ints
    corners: Ints
    counts: Ints
    offsets: Floats
    done: tuple[str, ...]


def plan_repair(character: Character, garment: Garment, rig: ProxyRig | None, *, topology: bool = True) -> MeshRepair:
    """Plan all safe repairs of a garment.

    Seams whose vertices share place, class and weights are sewn; faces that collapse by it or lie on others, and
    vertices in no face, go; faces are wound alike and away from the body; shallow penetration is pushed out.

    Args:
        rig: proxies authored for the garment, whose weights must agree too where vertices merge.
        topology: whether vertices and faces may go; if not, they are only flipped and pushed.
    """
    mesh, body = garment.mesh, character.merged_body().mesh
    target = merge_targets(garment, rig, character) if topology else np.arange(mesh.vertex_count)
    polygons, corners, counts, removed = _kept_polygons(mesh, target, topology)
    vertices = target[mesh.indices_of_corners[corners]]
    flips = outward_flips(mesh.points, counts, vertices, body)
    corners = corners[_flipped_order(counts, flips)]
    kept = np.unique(vertices) if topology else np.arange(mesh.vertex_count)
    new_index = np.full(mesh.vertex_count, -1)
    new_index[kept] = np.arange(len(kept))
    offsets = push_out(mesh.points, edges(mesh.faces), body)[kept]
    merged = int(np.count_nonzero(target != np.arange(len(target))))
    done = _told({
        "vertices merged": merged, "isolated vertices removed": mesh.vertex_count - len(kept) - merged,
        "faces removed": removed, "faces flipped": int(flips.sum()),
        f"vertices pushed out to {1000 * MARGIN:g} mm": int(offsets.any(axis=1).sum()),
    })  # fmt: skip
    return MeshRepair(kept, new_index[target], polygons, corners, counts, offsets, done)


def merge_targets(garment: Garment, rig: ProxyRig | None, character: Character) -> Ints:
    """Return the vertex that each one merges into, itself mostly, shape (V,).

    Vertices merge where they share place, class and weights, at the borders of panels or along an edge without
    length, and only as long as no edge comes to have more than two faces: layers that touch stay apart.
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
    """Return a label for each vertex (V,), equal where place, class and weights are equal."""
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
    """Return the vertices (V,) on edges that merging would give more faces than two, and more than before."""
    _, before = edge_use(faces)
    merged = target[faces]
    whole = (merged != np.roll(merged, 1, axis=1)).all(axis=1)
    pairs, uses = edge_use(np.unique(np.sort(merged[whole], axis=1), axis=0))
    worst = max(2, int(before.max()))
    return np.isin(target, pairs[uses > worst])


def _kept_polygons(mesh: Mesh, target: Ints, topology: bool) -> tuple[Ints, Ints, Ints, int]:
    """Return polygons, corners and counts that stay when vertices merge into `target` (V,), and how many go."""
    assert mesh.polygon_counts is not None
    counts, vertices = mesh.polygon_counts.astype(np.int64), target[mesh.indices_of_corners]
    every, corners = np.arange(len(counts)), np.arange(len(vertices))
    if not topology:
        return every, corners, counts, 0
    owner = np.repeat(every, counts)
    before = corners - 1
    before[np.cumsum(counts) - counts] += counts
    stays = vertices != vertices[before]
    left = np.bincount(owner, stays, minlength=len(counts)).astype(np.int64)
    whole = (left >= 3) & _first_of_kind(owner[stays], vertices[stays], len(counts))
    stays &= whole[owner]
    return every[whole], corners[stays], left[whole], int(np.count_nonzero(~whole))


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
    """Return the order of corners in which the polygons `flips` (P,) run backwards."""
    start = np.repeat(np.cumsum(counts) - counts, counts)
    last = np.repeat(np.cumsum(counts) - 1, counts)
    position = np.arange(len(start))
    return np.where(np.repeat(flips, counts), last - (position - start), position)


def _told(amounts: dict[str, int]) -> tuple[str, ...]:
    return tuple(f"{amount} {what}" for what, amount in amounts.items() if amount)
