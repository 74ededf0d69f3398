# SPDX-License-Identifier: Apache-2.0
"""Which cloth touches which, on which side, as a garment moves.

A pair of a vertex and a face, or of two edges, has a side while it faces each other (`pairs`). A solver tells which
positions it has moved to. There a pair that has no side takes the one on which it is, and one that faces each other
no more loses it. In positions that are only tried, and after the body has moved, cloth may have passed through: the
pair then still belongs to its side, and is pushed back, in later steps too.

Pinned and tight cloth does not touch itself: it follows skin, which leaves no room between it where it folds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from ...errors import fail
from ...scene.assets import LOOSE, Scene
from ...scene.fabrics import Fabric
from ...scene.mesh import topology
from ..energy.collision import ContactLaw
from .contacts import ClothContacts
from .neighbours import near_pairs
from .pairs import Separations, between_edges, over_faces

REACH = 0.015  # [m] beyond the contact distance, within which pairs are known
TRIED, MOVED = 0.5, 0.1  # of that, by which vertices may be elsewhere where positions are tried, and moved to
STRETCH = 1.3  # by which faces and edges may be longer than at rest
CLOSER = 0.7  # of the distance at rest: pairs that are nearer there touch at this, as along seams and slits
VERTEX_SHARE = 0.5  # of a vertex's area: both of two layers count
EDGE_SHARE = 0.25  # of an edge's area: it makes the smaller part of the pressure of two layers

Shape = Callable[[Tensor], Separations]


@dataclass(frozen=True, eq=False)
class KnownPairs:
    """Pairs of one kind in N frames, by ascending frame, first and second.

    Attributes:
        frame: shape (P,).
        first, second: vertex and face, or two edges, shape (P,).
        side: 1 or -1, or 0 where a pair has none, shape (P,).
        start: gap at which contact begins [m], shape (P,).
    """

    frame: Tensor
    first: Tensor
    second: Tensor
    side: Tensor
    start: Tensor

    def kept(self, kept: Tensor, frame: Tensor | None = None) -> KnownPairs:
        """Return the pairs that `kept` (P,) names, with other frames (P,) where they are given."""
        own = self.frame if frame is None else frame
        return KnownPairs(own[kept], self.first[kept], self.second[kept], self.side[kept], self.start[kept])

    def select(self, frames: Tensor, count: int) -> KnownPairs:
        """Return those in the frames with indices (M,), in ascending order, of a number of frames."""
        place = torch.full((count,), -1, device=frames.device)
        place[frames] = torch.arange(len(frames), device=frames.device)
        new = place[self.frame]
        return self.kept(new >= 0, new)

    def sides_of(self, other: KnownPairs) -> Tensor:
        """Return the sides of other pairs as far as they are known here, 0 elsewhere."""
        if not len(self.frame) or not len(other.frame):
            return torch.zeros_like(other.side)
        size = 1 + int(max(pairs.max() for pairs in (self.first, self.second, other.first, other.second)))
        own, asked = ((pairs.frame * size + pairs.first) * size + pairs.second for pairs in (self, other))
        at = torch.searchsorted(own, asked).clamp_max(len(own) - 1)
        return torch.where(own[at] == asked, self.side[at], 0)


@dataclass(frozen=True, eq=False)
class ClothNeighbours:
    """What may touch in N frames.

    Attributes:
        last: positions that the garment moved to last [m], shape (V, 3, N).
        at: positions around which pairs are known [m], shape (V, 3, N).
        faces, edges: the pairs: vertices over faces, and edges.
    """

    last: Tensor
    at: Tensor
    faces: KnownPairs
    edges: KnownPairs

    def select(self, frames: Tensor) -> ClothNeighbours:
        """Return those in the frames with indices (M,), in ascending order."""
        count = self.at.shape[-1]
        faces, edges = self.faces.select(frames, count), self.edges.select(frames, count)
        return ClothNeighbours(self.last[..., frames], self.at[..., frames], faces, edges)

    @classmethod
    def joined(cls, parts: Sequence[tuple[Tensor, ClothNeighbours]]) -> ClothNeighbours:
        """Return those of all frames from parts, each with the indices of its frames (M,)."""
        order = torch.cat([frames for frames, _ in parts]).argsort()

        def pairs(name: str) -> KnownPairs:
            own = [(frames, getattr(part, name)) for frames, part in parts]
            found = KnownPairs(
                torch.cat([frames[part.frame] for frames, part in own]),
                *(
                    torch.cat([getattr(part, item) for _, part in own])
                    for item in ("first", "second", "side", "start")
                ),
            )
            rows = found.frame.argsort(stable=True)
            return found.kept(rows)

        last, at = (torch.cat([getattr(part, name) for _, part in parts], -1)[..., order] for name in ("last", "at"))
        return cls(last, at, pairs("faces"), pairs("edges"))

    def first(self, frames: int) -> ClothNeighbours:
        """Return those of the first frames."""
        return self.select(torch.arange(frames, device=self.at.device))


class SelfContact:
    """Contact of a garment with itself; positions are (V, 3, N).

    Attributes:
        law: how pressure depends on the gap.
        reach: distance within which pairs are known [m].
        rest: the garment in the bind pose, shape (V, 3, 1).
    """

    def __init__(self, scene: Scene, fabric: Fabric, device: torch.device, dtype: torch.dtype) -> None:
        def tensor(values: np.ndarray, kind: torch.dtype = dtype) -> Tensor:
            return torch.as_tensor(np.array(values), dtype=kind, device=device)

        points, faces = scene.garment.mesh.points, scene.garment.mesh.faces
        edges, half = topology.edges(faces), topology.half_edges(faces)
        gap = 0.5 * fabric.margin
        self.law = ContactLaw(fabric.loose_contact, fabric.thickness + gap, gap)
        self.reach = self.law.start + REACH
        self.rest = tensor(points)[:, :, None]
        self.faces, self.edges = tensor(faces, torch.long), tensor(edges, torch.long)
        self._loose = tensor(scene.classes == LOOSE, torch.bool)
        self._face_reach, self._edge_reach = (tensor(STRETCH * _radii(points[part])) for part in (faces, edges))
        areas = topology.face_areas(points, faces)
        own = np.searchsorted(topology.edge_keys(edges), topology.edge_keys(half))
        self._vertex_area = VERTEX_SHARE * tensor(topology.vertex_areas(points, faces))
        self._edge_area = EDGE_SHARE * tensor(np.bincount(own, np.repeat(areas / 3, 3), len(edges)))

    def neighbours(self, last: Tensor, at: Tensor, before: ClothNeighbours | None = None) -> ClothNeighbours:
        """Return what may touch around positions `at`, on the sides of the positions `last`, or older ones."""
        if not bool(at.isfinite().all()):
            fail("simulation", "positions that are not finite", "cloth cannot be kept apart from cloth there")
        reach = self.reach
        vertices = torch.full_like(self._vertex_area, reach)
        frame, vertex, face = near_pairs(at, vertices, at[self.faces].mean(1), self._face_reach)
        apart = (vertex != self.faces[face].T).all(0)
        faces = self._sided(
            over_faces, last, at, frame[apart], vertex[apart], face[apart], before.faces if before else None
        )
        middle = at[self.edges].mean(1)
        frame, first, second = near_pairs(middle, self._edge_reach + reach, middle, self._edge_reach)
        shared = self.edges[first][:, :, None] == self.edges[second][:, None]
        apart = (first < second) & ~shared.flatten(1).any(1)
        pairs = frame[apart], first[apart], second[apart]
        return ClothNeighbours(
            last, at, faces, self._sided(between_edges, last, at, *pairs, before.edges if before else None)
        )

    def around(self, x: Tensor, known: ClothNeighbours, allowance: float = TRIED) -> ClothNeighbours:
        """Return what may touch around positions x: what is known, in frames where vertices are near enough."""
        stale = ~(_drift(x, known) <= allowance * REACH)
        if not bool(stale.any()):
            return known
        old, new = (~stale).nonzero()[:, 0], stale.nonzero()[:, 0]
        again = self.neighbours(known.last[..., new], x[..., new], known.select(new))
        return ClothNeighbours.joined([(old, known.select(old)), (new, again)]) if len(old) else again

    def moved(self, x: Tensor, known: ClothNeighbours) -> ClothNeighbours:
        """Return what may touch after the garment has moved to positions x, with the sides there.

        What lies further on the wrong side than contact begins belongs there from now on.
        """
        known = self.around(x, known, MOVED)

        def there(shape: Shape, pairs: KnownPairs) -> KnownPairs:
            now = shape(self._corners(shape, x, pairs))
            away = pairs.side * now.height < -self.law.start
            side = torch.where((pairs.side == 0) | away, now.height.sign(), pairs.side)
            return replace(pairs, side=torch.where(now.facing, side, 0))

        return ClothNeighbours(x, known.at, there(over_faces, known.faces), there(between_edges, known.edges))

    def contacts(self, x: Tensor, known: ClothNeighbours) -> ClothContacts:
        """Return the contacts at positions x, among pairs that are known around them."""
        parts = [self._part(over_faces, x, known.faces), self._part(between_edges, x, known.edges)]
        joined = [torch.cat(part, dim=-1) for part in zip(*parts)]
        order = joined[0].argsort(stable=True)
        unknown = self.reach - 2 * _drift(x, known)
        return ClothContacts(self.law, x.shape[-1], unknown, *(part[..., order] for part in joined))

    def _vertices(self, shape: Shape, pairs: KnownPairs) -> Tensor:
        """Return the vertices of each pair, shape (4, P)."""
        first = pairs.first[None] if shape is over_faces else self.edges[pairs.first].T
        second = self.faces if shape is over_faces else self.edges
        return torch.cat([first, second[pairs.second].T])

    def _corners(self, shape: Shape, x: Tensor, pairs: KnownPairs) -> Tensor:
        frame = pairs.frame if x.shape[-1] > 1 else torch.zeros_like(pairs.frame)
        return x[self._vertices(shape, pairs), :, frame].movedim(-1, 1)

    def _sided(
        self,
        shape: Shape,
        last: Tensor,
        at: Tensor,
        frame: Tensor,
        first: Tensor,
        second: Tensor,
        before: KnownPairs | None,
    ) -> KnownPairs:
        none = at.new_zeros(frame.shape)
        pairs = KnownPairs(frame, first, second, none, none)
        pairs = pairs.kept(self._loose[self._vertices(shape, pairs)].any(0))
        pairs = pairs.kept(shape(self._corners(shape, at, pairs)).distance < self.reach)
        at_rest = shape(self._corners(shape, self.rest, pairs)).distance
        pairs = replace(pairs, start=(CLOSER * at_rest).clamp_max(self.law.start))
        then = shape(self._corners(shape, last, pairs))
        side = torch.where(then.facing, then.height.sign(), 0)
        older = torch.zeros_like(side) if before is None else before.sides_of(pairs)
        return replace(pairs, side=torch.where(older == 0, side, older))

    def _part(self, shape: Shape, x: Tensor, pairs: KnownPairs) -> tuple[Tensor, ...]:
        now = shape(self._corners(shape, x, pairs))
        gap, direction = now.gaps(pairs.side)
        kept = gap < pairs.start + REACH
        pairs, vertices = pairs.kept(kept), self._vertices(shape, pairs)[:, kept]
        second = torch.arange(4, device=x.device)[:, None] >= (1 if shape is over_faces else 2)
        if shape is over_faces:
            area = self._vertex_area[pairs.first]
        else:
            area = torch.minimum(self._edge_area[pairs.first], self._edge_area[pairs.second])
        moving = now.coefficients[:, kept], second.expand_as(vertices), direction[:, kept]
        return pairs.frame, vertices, *moving, pairs.start, area


def _drift(x: Tensor, known: ClothNeighbours) -> Tensor:
    """Return how far from where pairs are known a vertex of each frame is at most [m], shape (N,).

    What all move alike counts for nothing: it brings none together.
    """
    away = x - known.at
    return (away - away.mean(0)).norm(dim=1).amax(0)


def _radii(corners: np.ndarray) -> np.ndarray:
    """Return the distance of the farthest corner (E, C, 3) of each element from their mean, shape (E,)."""
    return np.linalg.norm(corners - corners.mean(axis=1, keepdims=True), axis=2).max(axis=1)
