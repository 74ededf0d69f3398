# SPDX-License-Identifier: Apache-2.0
"""Where edges of a garment cross its triangles, and forces that shorten the contours along which it intersects.

Two triangles that intersect have a segment in common. Each of its ends is where an edge of one crosses the other, or
a vertex that they share. Pulled towards the other end, an end slides along its edge e as far as the edge and the face
with normal n part: a pull p on it is p - (p.e / n.e) n on the edge, and the opposite of the last part on the face
[Volino, Magnenat-Thalmann 2006]. So `contours` of training does it in torch, which leaves out triangles with a common
vertex; a certificate needs these as well.
"""

from __future__ import annotations

import numpy as np

from ...scene.assets import Floats, Ints

STEEPEST = 0.2  # sine of the angle between an edge and a face, from which on an end slides freely


def contour_forces(points: Floats, faces: Ints, pairs: Ints) -> Floats:
    """Return forces on vertices (V, 3) that shorten what pairs of triangles (P, 2) have in common, by unit pulls."""
    forces = np.zeros_like(points)
    if not len(pairs):
        return forces
    both = faces[pairs]  # (P, 2, 3)
    shared = both[:, 0, :, None] == both[:, 1, None, :]  # (P, 3, 3)
    common = shared.any(axis=2).argmax(axis=1)
    is_joined = shared.any(axis=(1, 2))
    ends = np.stack([_crossing(points, *each) for each in _edges_and_faces(both)], axis=1)  # (P, 6, 4)
    hit = ends[..., 3] > 0
    corner = points[both[np.arange(len(both)), 0, common]]
    for row in range(len(pairs)):
        places = [ends[row, side, :3] for side in np.flatnonzero(hit[row])]
        sides = np.flatnonzero(hit[row]).tolist()
        if is_joined[row] and len(places) == 1:
            targets = [corner[row]]
        elif len(places) >= 2:
            far = _farthest(places)
            places, sides = [places[i] for i in far], [sides[i] for i in far]
            targets = places[::-1]
        else:
            continue
        for side, place, target in zip(sides, places, targets):
            _pull(forces, points, both[row], side, place, target - place)
    return forces


def _farthest(places: list[Floats]) -> tuple[int, int]:
    """Return the two places that are farthest apart."""
    count = len(places)
    pairs = [(i, j) for i in range(count) for j in range(i)]
    return max(pairs, key=lambda pair: float(np.linalg.norm(places[pair[0]] - places[pair[1]])))


def _edges_and_faces(both: Ints) -> list[tuple[Ints, Ints, Ints]]:
    """Return the starts and ends of the edges of each triangle of pairs (P, 2, 3), and the other triangle."""
    return [
        (both[:, own, corner], both[:, own, (corner + 1) % 3], both[:, 1 - own])
        for own in range(2)
        for corner in range(3)
    ]


def _crossing(points: Floats, start: Ints, end: Ints, face: Ints) -> Floats:
    """Return where edges cross faces (P, 3), with 1 where they do and have no vertex in common, else 0: (P, 4)."""
    apart = ((start[:, None] != face) & (end[:, None] != face)).all(axis=1)
    a, b, c = (points[face[:, corner]] for corner in range(3))
    p, q = points[start], points[end]
    normal = np.cross(b - a, c - a)
    before, after = ((p - a) * normal).sum(axis=1), ((q - a) * normal).sum(axis=1)
    through = (before > 0) != (after > 0)
    share = np.where(through, before / np.where(through, before - after, 1.0), 0.0)
    place = p + share[:, None] * (q - p)
    inside = np.ones(len(face), dtype=bool)
    for one, other in ((a, b), (b, c), (c, a)):
        inside &= (np.cross(other - one, place - one) * normal).sum(axis=1) >= 0
    return np.concatenate([place, (apart & through & inside)[:, None]], axis=1)


def _pull(forces: Floats, points: Floats, both: Ints, side: int, place: Floats, pull: Floats) -> None:
    """Add the forces of an end that is pulled along a vector."""
    own, corner = divmod(side, 3)
    start, end, face = both[own, corner], both[own, (corner + 1) % 3], both[1 - own]
    edge = points[end] - points[start]
    length = float(np.linalg.norm(edge))
    a, b, c = points[face]
    normal = np.cross(b - a, c - a)
    twice, size = float(np.linalg.norm(normal)), float(np.linalg.norm(pull))
    if not (length > 0 and twice > 0 and size > 0):
        return
    edge, normal, pull = edge / length, normal / twice, pull / size
    slope = float(normal @ edge)
    slope = np.copysign(max(abs(slope), STEEPEST), slope)
    off = float(pull @ edge) / slope * normal
    share = float(np.clip((place - points[start]) @ edge / length, 0, 1))
    on_edge = pull - off
    forces[start] += (1 - share) * on_edge
    forces[end] += share * on_edge
    for vertex, weight in zip(face, _barycentric(place, a, b, c)):
        forces[vertex] += weight * off


def _barycentric(place: Floats, a: Floats, b: Floats, c: Floats) -> Floats:
    normal = np.cross(b - a, c - a)
    square = float(normal @ normal)
    u = float(np.cross(place - a, c - a) @ normal) / square
    v = float(np.cross(b - a, place - a) @ normal) / square
    return np.array([1 - u - v, u, v]).clip(0, 1)
