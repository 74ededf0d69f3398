# SPDX-License-Identifier: Apache-2.0
"""Which cloth touches which, on which side, as a garment moves.

A pair of a vertex and a face, or of two edges, has a side while it faces each other (`pairs`). A solver tells which
positions it has moved to. There a pair that has no side takes the one on which it is, and one that faces each other
no more loses it. In positions that are only tried, and after the body has moved, cloth may have passed through: the
pair then still belongs to its side, and is pushed back, in later steps too.

Many pairs lie near each other, and few touch. All near pairs are found around positions, with their distances there.
At other positions a pair is nearer by at most what its vertices have moved since, so that most need no other look
(`PairKind.close`). Near pairs are looked for anew where the garment has left, and where a step would be cut short by
what is not known. A side is kept only for pairs on the wrong one: all others are on theirs at the last positions.

Pinned and tight cloth does not touch itself: it follows skin, which leaves no room between it where it folds. Tight
cloth of two garments touches where one lies on the other in the bind pose.

Cloth of two kinds touches at the mean of the distances and with the mean of the stiffnesses that each has with its
own kind.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from ...errors import fail
from ...scene.mesh import topology
from .. import kernels, loops
from ..energy.collision import ContactLaw
from ..framed import consecutive
from .cloth import TouchingCloth
from .contacts import CLOSING, SLACK, TINY, ClothContacts
from .neighbours import Grid, near_pairs, places_among
from .pairs import Separations, between_edges, over_faces

if TYPE_CHECKING:
    from ..kernels.cloth_contacts import PairTable

REACH = 0.015  # [m] beyond the contact distance, within which pairs are known
LEFT, MOVED = 0.5, 0.2  # of that, by which vertices may be elsewhere, and where they are when a step is cut short
DEEPER = 2e-3  # [m] by which cloth may have passed further through cloth than contact reaches, where it is only tried
STRETCH = 1.3  # by which faces and edges may be longer than at rest
CLOSER = 0.7  # of the distance at rest: pairs that are nearer there touch at this, as along seams and slits
VERTEX_SHARE = 0.5  # of a vertex's area: both of two layers count
EDGE_SHARE = 0.25  # of an edge's area: it makes the smaller part of the pressure of two layers


@dataclass(frozen=True, eq=False)
class KnownPairs:
    """Pairs of one kind in N frames, by ascending frame.

    Attributes:
        frame: shape (P,).
        first, second: vertex and face, or two edges, shape (P,).
        distance: at the positions around which pairs are known [m], shape (P,).
        side: 1 or -1, where a pair belongs that was on the other side at the last positions, else 0, shape (P,).
    """

    frame: Tensor
    first: Tensor
    second: Tensor
    distance: Tensor
    side: Tensor

    def kept(self, kept: Tensor, frame: Tensor | None = None) -> KnownPairs:
        """Return the pairs that `kept` (P,) names, with other frames (P,) where they are given."""
        own = self.frame if frame is None else frame
        return KnownPairs(own[kept], self.first[kept], self.second[kept], self.distance[kept], self.side[kept])

    def select(self, frames: Tensor, count: int) -> KnownPairs:
        """Return those in the frames with indices (M,), in ascending order, of a number of frames."""
        new = places_among(self.frame, frames, count)
        return self.kept(new >= 0, new)

    def sides_of(self, other: KnownPairs) -> Tensor:
        """Return the sides of other pairs as far as they are kept here, 0 elsewhere."""
        own = self.kept(self.side != 0)
        if not len(own.frame) or not len(other.frame):
            return torch.zeros_like(other.side)
        size = 1 + int(max(pairs.max() for pairs in (own.first, own.second, other.first, other.second)))
        keys, asked = ((pairs.frame * size + pairs.first) * size + pairs.second for pairs in (own, other))
        keys, order = keys.sort()
        at = torch.searchsorted(keys, asked).clamp_max(len(keys) - 1)
        return torch.where(keys[at] == asked, own.side[order[at]], 0)


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
        if len(frames) == count:
            return self
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
                    for item in ("first", "second", "distance", "side")
                ),
            )
            rows = found.frame.argsort(stable=True)
            return found.kept(rows)

        last, at = (torch.cat([getattr(part, name) for _, part in parts], -1)[..., order] for name in ("last", "at"))
        return cls(last, at, pairs("faces"), pairs("edges"))

    @classmethod
    def concatenated(cls, parts: Sequence[ClothNeighbours]) -> ClothNeighbours:
        """Return those of the frames of several, one after the other."""
        places = consecutive([part.at.shape[-1] for part in parts], parts[0].at.device)
        return cls.joined(list(zip(places, parts)))

    def replace_frames(self, frames: Tensor, other: ClothNeighbours) -> ClothNeighbours:
        """Return those with frames (M,), in ascending order, replaced by those of another."""
        if len(frames) == self.at.shape[-1]:
            return other
        kept = torch.ones(self.at.shape[-1], dtype=torch.bool, device=self.at.device)
        kept[frames] = False
        own = kept.nonzero()[:, 0]
        return ClothNeighbours.joined([(own, self.select(own)), (frames, other)])


@dataclass(frozen=True, eq=False)
class PairKind:
    """A kind of pair: vertices and faces, or edges and edges.

    Attributes:
        measure: returns the separations of pairs from the positions of their vertices (4, 3, P).
        first, second: vertices of what comes first in a pair, and second, shapes (A, a) and (B, b) with a + b = 4;
            the same tensor where both are of one sort.
        first_reach, second_reach: distance of vertices from the middle, at most [m], shapes (A,) and (B,).
        first_area, second_area: of which the smaller one counts for a pair [m2], shapes (A,) and (B,).
        first_start, second_start: gaps at which contact with its own kind begins [m], shapes (A,) and (B,).
        first_stiffness, second_stiffness: of contact with its own kind, relative to the law's, likewise; None where
            all have the law's.
    """

    measure: Callable[[Tensor], Separations]
    first: Tensor
    second: Tensor
    first_reach: Tensor
    second_reach: Tensor
    first_area: Tensor
    second_area: Tensor
    first_start: Tensor
    second_start: Tensor
    first_stiffness: Tensor | None
    second_stiffness: Tensor | None

    def table(self, pairs: KnownPairs) -> PairTable:
        """Return pairs of this kind, for kernels."""
        from ..kernels.cloth_contacts import PairTable

        names = (field.name for field in fields(self) if field.name not in ("measure", "first_reach", "second_reach"))
        return PairTable(
            **{name: getattr(self, name) for name in names},
            frame=pairs.frame,
            one=pairs.first,
            other=pairs.second,
            distance=pairs.distance,
            side=pairs.side,
        )

    def near(self, at: Tensor, reach: float, garment: Tensor | None = None) -> KnownPairs:
        """Return pairs without a common vertex that lie within reach of each other; sides are 0.

        Args:
            garment: of each vertex, where only those of two garments are pairs, shape (V,).
        """
        middles, ascending = (at[self.first].mean(1), at[self.second].mean(1)), self.first is self.second
        groups = None if garment is None else (garment[self.first[:, 0]], garment[self.second[:, 0]])
        reaches = self.first_reach + reach, self.second_reach
        if kernels.available(at.device) or loops.available(at.device):
            if kernels.available(at.device):
                from ..kernels.near_pairs import near_kernel as find
            else:
                from ..loops.separations import near_loop as find

            grid = Grid.of(middles[1], middles[0], float(reaches[0].max() + reaches[1].max()))
            found = find(at, self.first, self.second, middles, reaches, grid, groups, ascending, reach)
            frame, first, second, distance = found
            return KnownPairs(frame, first, second, distance, torch.zeros_like(distance))
        frame, first, second = near_pairs(
            middles[0], reaches[0], middles[1], reaches[1], groups=groups, ascending=ascending
        )
        one, other = self.first[first].T, self.second[second].T
        none = at.new_zeros(len(frame))
        pairs = KnownPairs(frame, first, second, none, none)
        distance = self.at([at], pairs)[0].distance
        kept = (distance < reach) & (one[:, None] != other).flatten(0, 1).all(0)
        return replace(pairs, distance=distance).kept(kept)

    def close(self, x: Tensor, pairs: KnownPairs, moved: Tensor, near: float, step: Tensor | None = None) -> Tensor:
        """Return the rows of pairs that are close at positions x (V, 3, N).

        Close are those nearer than `near` [m], and those which come nearer in a step (V, 3, N), or in one in which
        some vertices are slower, by more than `CLOSING` of their distance.

        Args:
            moved: how far each vertex has moved since pairs were found, shape (V, N).
        """
        if step is not None:
            moved = moved + step.norm(dim=1) / CLOSING
        moves = moved[self.first].amax(1), moved[self.second].amax(1)
        if loops.available(x.device):
            from ..loops.separations import close_loop

            given = pairs.frame, pairs.first, pairs.second, pairs.distance, moves, near, step, CLOSING
            return close_loop(x, self.first, self.second, *given).nonzero()[:, 0]
        bound = pairs.distance - moves[0][pairs.first, pairs.frame] - moves[1][pairs.second, pairs.frame]
        rows = (bound < near).nonzero()[:, 0]
        found = pairs.kept(rows)
        (now,) = self.at([x], found)
        kept = now.distance < near
        if step is not None:
            along = (now.direction * step[self.vertices(found), :, found.frame].movedim(-1, 1)).sum(1)
            count = self.first.shape[1]
            closing = along[count:].clamp_min(0).amax(0) - along[:count].clamp_max(0).amin(0)
            kept |= closing > CLOSING * now.distance
        return rows[kept]

    def vertices(self, pairs: KnownPairs) -> Tensor:
        """Return the vertices of each pair, shape (4, P)."""
        return torch.cat([self.first[pairs.first].T, self.second[pairs.second].T])

    def at(self, places: Sequence[Tensor], pairs: KnownPairs) -> list[Separations]:
        """Return how pairs are separated at several positions (V, 3, N), or at (V, 3, 1) for all frames."""
        if kernels.available(pairs.frame.device):
            from ..kernels.separations import separations_kernel

            own = self.first, self.second, pairs.frame, pairs.first, pairs.second
            return [Separations(*separations_kernel(x, *own)) for x in places]
        vertices, none = self.vertices(pairs), torch.zeros_like(pairs.frame)
        corners = [x[vertices, :, pairs.frame if x.shape[-1] > 1 else none] for x in places]
        found, count = self.measure(torch.cat(corners, dim=1).movedim(-1, 1)), len(none)
        return [found.kept(slice(number * count, (number + 1) * count)) for number in range(len(places))]

    def contacts(self, now: Separations, pairs: KnownPairs, side: Tensor, rest: Separations) -> tuple[Tensor, ...]:
        """Return what `ClothContacts` holds of pairs on sides (P,) as they lie `now`, and in the bind pose."""
        gap, direction = now.gaps(side)
        vertices = self.vertices(pairs)
        second = (torch.arange(4, device=gap.device) >= self.first.shape[1])[:, None].expand_as(vertices)
        most = _mean(self.first_start, self.second_start, pairs)
        start = torch.minimum(CLOSER * rest.distance, most)
        area = torch.minimum(self.first_area[pairs.first], self.second_area[pairs.second])
        if self.first_stiffness is not None and self.second_stiffness is not None:
            area = area * _mean(self.first_stiffness, self.second_stiffness, pairs)
        return pairs.frame, vertices, now.coefficients, second, direction, start, area


class SelfContact:
    """Contact of cloth with cloth; positions are (V, 3, N).

    Attributes:
        law: how pressure depends on the gap, for the cloth that is thickest and stiffest.
        reach: distance within which pairs are known [m].
        rest: the cloth in the bind pose, shape (V, 3, 1).

    Args:
        own: whether garments touch themselves; each other alone otherwise.
    """

    def __init__(self, cloth: TouchingCloth, device: torch.device, dtype: torch.dtype, own: bool = True) -> None:
        def tensor(values: np.ndarray, kind: torch.dtype = dtype) -> Tensor:
            return torch.as_tensor(np.array(values), dtype=kind, device=device)

        points, faces = cloth.points, cloth.faces
        edges, half = topology.edges(faces), topology.half_edges(faces)
        stiffest = float(cloth.stiffness.max())
        self.law = ContactLaw(stiffest, float(cloth.start.max()), cloth.ramp)
        self.reach = self.law.start + REACH
        self.rest = tensor(points)[:, :, None]
        self._loose, self._pinned = tensor(cloth.loose, torch.bool), tensor(cloth.pinned, torch.bool)
        self._garment = tensor(cloth.garment, torch.long) if cloth.garment.any() else None
        self._own = own
        named = np.searchsorted(topology.edge_keys(edges), topology.edge_keys(half))
        of_edges = np.bincount(named, np.repeat(topology.face_areas(points, faces) / 3, 3), len(edges))
        vertices, corners, ends = (
            tensor(rows, torch.long) for rows in (np.arange(len(points))[:, None], faces, edges)
        )
        reach, area = tensor(STRETCH * _radii(points[edges])), EDGE_SHARE * tensor(of_edges)

        share = cloth.stiffness / stiffest if stiffest else np.ones(len(points))
        shares = None if (share == 1).all() else tensor(share)
        starts, of_faces, of_ends = tensor(cloth.start), corners[:, 0], ends[:, 0]
        self._faces = PairKind(
            over_faces,
            vertices,
            corners,
            tensor(np.zeros(len(points))),
            tensor(STRETCH * _radii(points[faces])),
            VERTEX_SHARE * tensor(topology.vertex_areas(points, faces)),
            tensor(np.full(len(faces), np.inf)),
            starts,
            starts[of_faces],
            shares,
            None if shares is None else shares[of_faces],
        )
        start, share_of = starts[of_ends], None if shares is None else shares[of_ends]
        self._edges = PairKind(between_edges, ends, ends, reach, reach, area, area, start, start, share_of, share_of)

    def neighbours(self, last: Tensor, at: Tensor, before: ClothNeighbours | None = None) -> ClothNeighbours:
        """Return what may touch around positions `at`, on the sides of the positions `last`, or older ones."""
        if not bool(at.isfinite().all()):
            fail("simulation", "positions that are not finite", "cloth cannot be kept apart from cloth there")
        faces = self._near(self._faces, last, at, before.faces if before else None)
        return ClothNeighbours(last, at, faces, self._near(self._edges, last, at, before.edges if before else None))

    def around(self, x: Tensor, known: ClothNeighbours) -> ClothNeighbours:
        """Return what may touch around positions x: what is known, in frames where vertices are near enough."""
        return self._anew(x, known, ~(_drift(x, known).amax(0) <= LEFT * REACH))

    def _anew(self, x: Tensor, known: ClothNeighbours, stale: Tensor) -> ClothNeighbours:
        """Return what may touch, in stale frames (N,) around positions x."""
        if not bool(stale.any()):
            return known
        new = stale.nonzero()[:, 0]
        return known.replace_frames(new, self.neighbours(known.last[..., new], x[..., new], known.select(new)))

    def moved(self, x: Tensor, known: ClothNeighbours) -> tuple[ClothNeighbours, ClothContacts]:
        """Return what may touch after the garment has moved to positions x, with the sides there, and the contacts.

        What lies further on the wrong side than contact begins belongs there from now on.
        """
        known = self.around(x, known)
        sides, found = self._touching(known, x, _drift(x, known), self.law.start, known.last, settled=True)
        pairs = (replace(own, side=side) for (_, own), side in zip(self._parts(known), sides))
        return ClothNeighbours(x, known.at, *pairs), found

    def contacts(self, x: Tensor, known: ClothNeighbours) -> ClothContacts:
        """Return the contacts at positions x, among pairs that are known around them."""
        return self._touching(known, x, _drift(x, known), self.law.start + DEEPER, known.last)[1]

    def ahead(self, step: Tensor, known: ClothNeighbours) -> tuple[ClothNeighbours, Tensor, ClothContacts]:
        """Return what may touch ahead of a step (V, 3, N) from the last positions, the step as far as no pairs can
        meet that are not known, and which contacts may slow it further.

        The step is cut as a whole. Where each vertex stopped by itself, cloth between those that stop and those that
        go on would stretch, and its energy would rise in all but a short part of the step. What all move alike
        counts, too, since contacts may hold some of them back; positions are about the character's root.
        """
        x, longest = known.last, step.norm(dim=1).amax(0)
        drift = _drift(x, known).amax(0)
        known = self._anew(x, known, (longest > self._unknown(drift)) & (drift > MOVED * REACH))
        drift = _drift(x, known)
        step = (self._unknown(drift.amax(0)) / longest.clamp_min(TINY)).clamp_max(1) * step
        return known, step, self._touching(known, x, drift, self.law.start + DEEPER, step=step)[1]

    def _parts(self, known: ClothNeighbours) -> tuple[tuple[PairKind, KnownPairs], tuple[PairKind, KnownPairs]]:
        """Return the kinds of pairs with what is known of them."""
        return (self._faces, known.faces), (self._edges, known.edges)

    def _touching(
        self,
        known: ClothNeighbours,
        x: Tensor,
        moved: Tensor,
        near: float,
        last: Tensor | None = None,
        *,
        settled: bool = False,
        step: Tensor | None = None,
    ) -> tuple[list[Tensor], ClothContacts]:
        """Return the sides of the known pairs at positions x, and the contacts of those that are close there.

        Args:
            moved, near, step: as `PairKind.close` takes them; without a step, contacts are those that press.
            last: positions at which pairs without a side have theirs; None where these have none.
            settled: whether only those keep a side that are on the wrong one, and not deeper than contact begins.
        """
        if kernels.available(x.device):
            from ..kernels.cloth_contacts import contacts_kernel

            tables = [kind.table(own) for kind, own in self._parts(known)]
            reach = moved if step is None else moved + step.norm(dim=1) / CLOSING
            sides, found = contacts_kernel(
                tables, x, last, self.rest, reach, near, start=self.law.start, closer=CLOSER, slack=SLACK,
                garment=self._garment, settled=settled, step=step, closing=CLOSING,
            )  # fmt: skip
            return sides, ClothContacts(self.law, x.shape[-1], *found)
        sides, parts = [], []
        for kind, own in self._parts(known):
            rows = kind.close(x, own, moved, near, step)
            close = own.kept(rows)
            now, rest, *before = kind.at([x, self.rest] if last is None else [x, self.rest, last], close)
            side = _sides(close, before[0]) if before else close.side
            if settled:
                wrong = now.facing & (side * now.height < 0) & (side * now.height >= -self.law.start)
                side = torch.where(wrong, side, 0)
            sides.append(torch.zeros_like(own.side).index_copy_(0, rows, side))
            parts.append(kind.contacts(now, close, side, rest))
        joined = self._joined(x, parts)
        return sides, joined.pressing(x) if step is None else joined

    def _unknown(self, drift: Tensor) -> Tensor:
        """Return how far each vertex may move after a drift (N,) [m], shape (N,): not to what is not known, nor so
        far that pairs must be looked for where a step is only tried."""
        return torch.minimum(0.5 * CLOSING * (self.reach - 2 * drift), LEFT * REACH - drift)

    def _joined(self, x: Tensor, parts: Sequence[tuple[Tensor, ...]]) -> ClothContacts:
        """Return contacts of both kinds."""
        joined = [torch.cat(part, dim=-1) for part in zip(*parts)]
        joined.append(self._slack(joined[1], joined[5]))
        return ClothContacts(self.law, x.shape[-1], *joined)

    def _slack(self, vertices: Tensor, start: Tensor) -> Tensor:
        """Return by which pairs that begin to touch later may come nearer, however near they are [m], shape (P,).

        Between garments there is none: tight cloth that lies on other cloth would be led through it in many steps.
        """
        slack = SLACK * (self.law.start - start)
        if self._garment is None:
            return slack
        return slack.masked_fill(self._garment[vertices[0]] != self._garment[vertices[-1]], 0.0)

    def _near(self, kind: PairKind, last: Tensor, at: Tensor, before: KnownPairs | None) -> KnownPairs:
        """Return the pairs of a kind that `neighbours` tells of."""
        pairs = kind.near(at, self.reach, None if self._own else self._garment)
        pairs = pairs.kept(self._can_touch(kind, pairs))
        return pairs if before is None else replace(pairs, side=before.sides_of(pairs))

    def _can_touch(self, kind: PairKind, pairs: KnownPairs) -> Tensor:
        """Tell which pairs of a kind may touch at all, bool (P,)."""
        loose = self._loose[kind.first].any(1)[pairs.first] | self._loose[kind.second].any(1)[pairs.second]
        if self._garment is None:
            return loose
        vertices = kind.vertices(pairs)
        other = self._garment[vertices[0]] != self._garment[vertices[-1]]
        beside = other & ~loose & ~self._pinned[vertices].all(0)
        rows = beside.nonzero()[:, 0]
        beside[rows] = kind.at([self.rest], pairs.kept(rows))[0].distance < self.reach
        return loose | beside  # of one garment alone, none is known where it may not touch itself


def _mean(first: Tensor, second: Tensor, pairs: KnownPairs) -> Tensor:
    """Return the means of what both of each pair have, shape (P,)."""
    return 0.5 * (first[pairs.first] + second[pairs.second])


def _sides(pairs: KnownPairs, last: Separations) -> Tensor:
    """Return the sides of pairs that lay as they did `last`, 0 where they have none, shape (P,)."""
    return torch.where(pairs.side == 0, torch.where(last.facing, last.height.sign(), 0), pairs.side)


def _drift(x: Tensor, known: ClothNeighbours) -> Tensor:
    """Return how far each vertex is from where pairs are known [m], shape (V, N).

    What all move alike counts for nothing: it brings none together.
    """
    away = x - known.at
    return (away - away.mean(0)).norm(dim=1)


def _radii(corners: np.ndarray) -> np.ndarray:
    """Return the distance of the farthest corner (E, C, 3) of each element from their mean, shape (E,)."""
    return np.linalg.norm(corners - corners.mean(axis=1, keepdims=True), axis=2).max(axis=1)
