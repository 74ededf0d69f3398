# SPDX-License-Identifier: Apache-2.0
"""Certify the frames of a garment: move those that are wrong, ease in and out of it, and say what has no free place.

Frames that are wrong are freed in their order. Each starts from the displacement of the frame before, where that was
wrong too, so that cloth leaves cloth on the same side; where it stays caught, from its own place, and last from the
frame after. Displacements are compared between frames in the garment's rest pose, as its skinning turns them.

Then the displacements of consecutive frames are smoothed, and fade before the first and after the last of them. Each
of these is a target to settle at (`settle`), so what is free stays free. A frame in which that uncovers skin keeps
what it had.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from ...scene.assets import Floats, Ints, Scene
from .faults import FaultFinder, FrameFaults, FrameSurroundings
from .metric import DisplacementMetric
from .settle import THICKNESS, Settler
from .untangle import Untangler

LENGTH = 0.02  # [m] over which displacements spread when cloth settles
EASE = 0.17  # [s] in which a displacement comes and goes
SMALLEST = 1e-6  # [m]: less is rounding
ROUNDS = 2  # of smoothing, each with weights 1, 2, 1


@dataclass(frozen=True, eq=False)
class Frames:
    """The frames of a shot, each computed when it is asked for.

    Attributes:
        count: of the frames.
        fps: frames per second [1/s].
        points: garment vertices in the world [m], shape (V, 3).
        body: vertices of the character's merged body there [m], shape (B, 3); None without one.
        turns: linear part of the blended skinning of each vertex, shape (V, 3, 3).
        cuts: frames that do not go on from the one before.
        beneath: vertices of the garments beneath, in the world [m], shape (W, 3); None without any.
    """

    count: int
    fps: float
    points: Callable[[int], Floats]
    body: Callable[[int], Floats | None]
    turns: Callable[[int], Floats]
    cuts: frozenset[int] = frozenset()
    beneath: Callable[[int], Floats] | None = None


@dataclass(frozen=True, eq=False)
class Certified:
    """What became of the frames of a shot.

    Attributes:
        faulty: frames in which something was wrong, in ascending order.
        points: of each frame that was moved, the positions of all vertices [m], shape (V, 3).
        left: what is still wrong, by frame.
    """

    faulty: tuple[int, ...]
    points: Mapping[int, Floats]
    left: Mapping[int, FrameFaults]


@dataclass(eq=False)
class _Moved:
    """A frame that is being freed: where it is free or best, what is left, and which vertices may move."""

    points: Floats
    left: FrameFaults
    moves: np.ndarray
    offsets: Floats = field(default_factory=lambda: np.zeros(0))


class Certifier:
    """Certifies shots of one garment.

    Args:
        scene: the garment on its character.
        beneath: triangles (G, 3) of the garments beneath it, which stay where they are.
    """

    def __init__(self, scene: Scene, beneath: Ints | None = None) -> None:
        import ipctk

        ipctk.set_num_threads(1)  # sums in another order have other last digits
        mesh = scene.garment.mesh
        self.finder = FaultFinder(scene, beneath)
        self.untangler = Untangler(mesh, self.finder)
        self.settler = Settler(mesh, self.finder, DisplacementMetric(mesh, LENGTH))

    def faults(self, frames: Frames, told: Callable[[], object] = lambda: None) -> dict[int, FrameFaults]:
        """Return what is wrong, by frame; `told` is called after each frame."""
        found = {}
        for frame in range(frames.count):
            faults = self.finder.find(frames.points(frame), self._skin(frames, frame))
            if faults.count:
                found[frame] = faults
            told()
        return found

    def certify(
        self,
        frames: Frames,
        faults: Mapping[int, FrameFaults],
        told: Callable[[], object] = lambda: None,
        thickness: float = THICKNESS,
    ) -> Certified:
        """Move the frames in which something is wrong, and those around them.

        Args:
            faults: by frame.
            told: called twice for each of them.
            thickness: at which cloth is kept from cloth [m].
        """
        moved: dict[int, _Moved] = {}
        for frame in sorted(faults):
            before = None if frame in frames.cuts else moved.get(frame - 1)
            moved[frame] = self._freed(frames, frame, faults[frame], before, thickness)
            told()
        for frame in sorted(faults, reverse=True):
            after = None if frame + 1 in frames.cuts else moved.get(frame + 1)
            if moved[frame].left.count and after is not None and not after.left.count:
                again = self._freed(frames, frame, faults[frame], after, thickness)
                if again.left.count < moved[frame].left.count:
                    moved[frame] = again
        eased = self._eased(frames, moved, thickness, told)
        together = dict(sorted({**moved, **eased}.items()))
        left = {frame: each.left for frame, each in together.items() if each.left.count}
        points = {frame: each.points for frame, each in together.items()}
        still = {frame: each for frame, each in points.items() if not np.array_equal(each, frames.points(frame))}
        return Certified(tuple(sorted(faults)), still, left)

    def again(
        self, frames: Frames, frame: int, points: Floats | None, thickness: float
    ) -> tuple[Floats, FrameFaults]:
        """Return where one frame is free with more room than before, or best, and what is left.

        Args:
            points: where it was moved to, shape (V, 3); None for its own place.
            thickness: at which cloth is kept from cloth [m].
        """
        own, skin = frames.points(frame), self._skin(frames, frame)
        start = own if points is None else points
        freed = self.untangler.free(start, skin)
        if not freed.is_free:
            return freed.points, freed.faults
        moves = freed.moved | (start != own).any(axis=1)
        settled = self._settled(freed.points, start, self._widened(moves), skin, thickness)
        return (freed.points, freed.faults) if settled is None else (settled.points, settled.left)

    def _widened(self, moves: np.ndarray) -> np.ndarray:
        """Return the vertices that move (V,), with their neighbours."""
        faces = self.untangler.mesh.faces
        found = moves.copy()
        found[faces[moves[faces].any(axis=1)].reshape(-1)] = True
        return found

    def _skin(self, frames: Frames, frame: int) -> FrameSurroundings | None:
        return self.finder.place(frames.body(frame), frames.beneath(frame) if frames.beneath else None)

    def _freed(
        self, frames: Frames, frame: int, faults: FrameFaults, near: _Moved | None, thickness: float
    ) -> _Moved:
        """Free a frame, from a neighbour's displacement first, and settle it at its own place."""
        own, skin, turns = frames.points(frame), self._skin(frames, frame), frames.turns(frame)
        starts = [(own, faults, np.zeros(len(own), dtype=bool))]
        if near is not None and not near.left.count:
            start = own + _turned(turns, near.offsets)
            starts.insert(0, (start, self.finder.find(start, skin), near.moves))
        best: _Moved | None = None
        for start, wrong, moves in starts:
            found = self.untangler.free(start, skin, wrong)
            if best is None or found.faults.count < best.left.count:
                best = _Moved(found.points, found.faults, moves | found.moved)
            if found.is_free:
                break
        assert best is not None
        if not best.left.count:
            settled = self._settled(best.points, own, best.moves, skin, thickness)
            best = best if settled is None else settled
        best.offsets = _unturned(turns, best.points - own)
        return best

    def _eased(
        self, frames: Frames, moved: Mapping[int, _Moved], thickness: float, told: Callable[[], object]
    ) -> dict[int, _Moved]:
        """Return the frames around those that moved, and what changes of these, for the sake of the course."""
        found: dict[int, _Moved] = {}
        free = {frame: each.offsets for frame, each in moved.items() if not each.left.count}
        steps = max(1, round(EASE * frames.fps))
        near = {frame: [(frame, 1.0)] for frame in free}  # whose displacements reach a frame, and by which shares
        for frame in free:
            for way in (-1, 1):
                for away in range(1, steps + 1):
                    at = frame + way * away
                    if not 0 <= at < frames.count or at in free or max(at, at - way) in frames.cuts:
                        break
                    near.setdefault(at, []).append((frame, _share(away, steps)))
        for first, last in runs(near, frames.cuts):
            sequence = range(first, last + 1)
            offsets = np.array([_blend(free, near[frame]) for frame in sequence])
            ends = [offsets[at] * (frame in free) for at, frame in ((0, first), (-1, last))]
            for _ in range(ROUNDS):
                padded = np.concatenate([ends[:1], offsets, ends[1:]])
                offsets = (padded[:-2] + 2 * padded[1:-1] + padded[2:]) / 4
            for frame, wanted in zip(sequence, offsets):
                eased = self._at(frames, frame, wanted, moved.get(frame), thickness)
                if eased is not None:
                    found[frame] = eased
                if frame in moved:
                    told()
        return found

    def _at(self, frames: Frames, frame: int, offsets: Floats, own: _Moved | None, thickness: float) -> _Moved | None:
        """Return a free frame near displacements in the rest pose; None where there is none but its own place."""
        place, skin = frames.points(frame), self._skin(frames, frame)
        moves = np.linalg.norm(offsets, axis=1) > SMALLEST
        start = place if own is None else own.points
        if own is not None:
            moves |= own.moves
        target = place + np.where(moves[:, None], _turned(frames.turns(frame), offsets), 0)
        if own is not None and own.left.count:  # nothing is free to start from
            left = self.finder.find(target, skin)
            return _Moved(target, left, moves) if left.count <= own.left.count else None
        return self._settled(start, target, moves, skin, thickness)

    def _settled(
        self, start: Floats, target: Floats, moves: np.ndarray, skin: FrameSurroundings | None, thickness: float
    ) -> _Moved | None:
        """Return a free frame near a target, lifted once more where that uncovered skin; None where it stays bare."""
        settled = self.settler.settle(start, target, moves, skin, thickness)
        found = self.untangler.free(settled, skin, lifts=True)
        return None if found.faults.count else _Moved(found.points, found.faults, moves | found.moved)


def runs(frames: Iterable[int], cuts: Iterable[int] = ()) -> list[tuple[int, int]]:
    """Return the first and last of each run of consecutive frames; a cut begins another."""
    found: list[tuple[int, int]] = []
    apart = set(cuts)
    for frame in sorted(frames):
        if found and found[-1][1] == frame - 1 and frame not in apart:
            found[-1] = (found[-1][0], frame)
        else:
            found.append((frame, frame))
    return found


def _blend(offsets: Mapping[int, Floats], near: Sequence[tuple[int, float]]) -> Floats:
    """Return the sum of shares of displacements (V, 3) of frames, and their mean where the shares exceed one."""
    whole = max(1.0, sum(share for _, share in near))
    return np.asarray(sum(share / whole * offsets[frame] for frame, share in near))


def _share(away: int, steps: int) -> float:
    """Return the share of a displacement that is left so many frames away from its run."""
    if away <= 0:
        return 1.0
    rest = 1 - away / (steps + 1)
    return rest * rest * (3 - 2 * rest)


def _turned(turns: Floats, offsets: Floats) -> Floats:
    return np.asarray(np.einsum("vij,vj->vi", turns, offsets))


def _unturned(turns: Floats, away: Floats) -> Floats:
    """Return displacements (V, 3) in the rest pose, through the inverse of the turns (V, 3, 3)."""
    moved = np.flatnonzero(away.any(axis=1))
    found = np.zeros_like(away)
    some = turns[moved]
    square = np.swapaxes(some, 1, 2) @ some + 1e-8 * np.eye(3)
    found[moved] = np.linalg.solve(square, np.einsum("vji,vj->vi", some, away[moved])[..., None])[..., 0]
    return found
