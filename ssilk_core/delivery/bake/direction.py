# SPDX-License-Identifier: Apache-2.0
"""A garment as an animator directs it: held to linear blend skinning for a while, and its poses held on twos.

Where it is held in full nothing is rolled out. The network starts anew in the last frame of that, at rest, as after a
cut: a garment is often held because the motion had flung or tangled it, and a state that went on below would bring
that back. Its poses are then mixed with the held ones, so that nothing jumps wherever the network begins.

On twos the motion is seen at the frames that are held alone, with straight ways between. A character that is itself
animated on twos would jerk the cloth otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ...scene.assets import Deformer, Floats, GarmentPose, Ints, Motion, Skeleton
from ...scene.held import HeldGarment
from ...scene.kinematics import split_at_cuts

CHUNK = 256  # frames in memory at once

Rolled = Callable[[int, int, int], Iterator[GarmentPose]]


@dataclass(frozen=True, eq=False)
class Direction:
    """How a garment is directed over S samples of a motion.

    Attributes:
        free: 0 where it is held to linear blend skinning, 1 where it moves freely, shape (S,).
        hold: samples that each pose is held.
        motion: the character's, at these samples.
        first: the sample from which held poses are counted.
    """

    free: Floats
    hold: int
    motion: Motion
    first: int

    def runs(self, skeleton: Skeleton) -> list[Ints]:
        """Return the samples at which poses are made (K,), for each part of the motion that holds them evenly.

        Poses that are held are made anew after each cut.
        """
        count = self.motion.frame_count
        if self.hold == 1:
            return [np.arange(count)]
        found, start = [], 0
        for span in split_at_cuts(self.motion, skeleton):
            stop = start + span.frame_count
            aligned = start + (self.first - start) % self.hold if start <= self.first < stop else start
            if 0 < start < aligned:  # handles would show the take before
                found.append(np.array([start]))
            found.append(np.arange(aligned, stop, self.hold) if aligned < stop else np.array([start]))
            start = stop
        return found

    def shown(self, made: Ints) -> NDArray[np.intp]:
        """Return which of the poses that are made at samples (K,) each sample shows, shape (S,)."""
        return np.maximum(np.searchsorted(made, np.arange(self.motion.frame_count), side="right") - 1, 0)


def free_stretches(free: Floats) -> list[tuple[int, int]]:
    """Return where the network is rolled out, as (first, stop); each begins in the last frame held in full."""
    on = np.flatnonzero(np.diff((free > 0).astype(int), prepend=0, append=0))
    return [(max(int(first) - 1, 0), int(stop)) for first, stop in zip(on[::2], on[1::2])]


class DirectedPoses:
    """The poses of a garment as it is directed.

    Args:
        rolled: yields the network's poses at samples first, first + step, ..., below stop, which it is called with.

    Attributes:
        off: RMS distance of held poses from linear blend skinning in each frame in which there are any [m].
    """

    def __init__(self, direction: Direction, deformer: Deformer, rolled: Rolled) -> None:
        self.direction, self.deformer, self.rolled = direction, deformer, rolled
        self.off: list[float] = []

    def poses(self, start: int, stop: int) -> Iterator[GarmentPose]:
        """Yield the poses of the samples from `start` on, some at a time, counted from there."""
        direction = self.direction
        runs = direction.runs(self.deformer.scene.character.skeleton)
        made, whole = np.concatenate(runs), GarmentPose.joined([self._made(run) for run in runs])
        shown = direction.shown(made)[start:stop]
        for at in range(0, len(shown), CHUNK):
            rows = shown[at : at + CHUNK]
            moved = None if whole.translations is None else whole.translations[rows]
            yield GarmentPose(at, whole.rotations[rows], whole.weights[rows], moved)

    @cached_property
    def _held(self) -> HeldGarment:
        return HeldGarment(self.deformer)

    def _made(self, samples: Ints) -> GarmentPose:
        """Return the poses that are made at evenly spaced samples (K,)."""
        free = self.direction.free[samples]
        if (free == 1).all():
            return self._network(samples, 0, len(samples), not (self.direction.free == 1).all())
        bound = np.flatnonzero(free < 1)  # fitting proxies takes longer than the network
        held = self._held_at(samples[bound])
        whole = [np.empty((len(samples), *values.shape[1:])) for values in _arrays(held)]

        def put(rows: Ints | slice, pose: GarmentPose) -> None:
            for values, new in zip(whole, _arrays(pose)):
                values[rows] = new

        put(bound, held)
        for first, stop in free_stretches(free):
            put(slice(first, stop), self._network(samples, first, stop, True))
            low, high = np.searchsorted(bound, (first, stop))
            rows = bound[low:high]
            begun = GarmentPose(0, *(values[rows] for values in whole))
            put(rows, self._held.blended(held.part(slice(low, high)), begun, free[rows]))
        return GarmentPose(0, *whole)

    def _network(self, samples: Ints, first: int, stop: int, moves: bool) -> GarmentPose:
        rolled = self.rolled(int(samples[first]), int(samples[stop - 1]) + 1, self.direction.hold)
        pose = GarmentPose.joined(list(rolled))
        if pose.translations is None and moves:
            places = np.broadcast_to(self._held.places, (pose.frame_count, *self._held.places.shape))
            return replace(pose, translations=places)
        return pose

    def _held_at(self, samples: Ints) -> GarmentPose:
        motion, found = self.direction.motion, []
        for at in range(0, len(samples), CHUNK):
            rows = samples[at : at + CHUNK]
            pose, off = self._held.pose(motion.picked(rows))
            self.off += off[self.direction.free[rows] < 1].tolist()
            found.append(replace(pose, start=at))
        return GarmentPose.joined(found)


def _arrays(pose: GarmentPose) -> tuple[Floats, Floats, Floats]:
    assert pose.translations is not None
    return pose.rotations, pose.weights, pose.translations
