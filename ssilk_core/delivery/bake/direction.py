# SPDX-License-Identifier: Apache-2.0
"""A garment as an animator directs it: held to linear blend skinning or a pose by hand, and its poses held on twos.

Where it is held in full nothing is rolled out. The network starts anew in the last frame of that, at rest, as after a
cut: a garment is often held because the motion had flung or tangled it, and a state that went on below would bring
that back. Its poses are then mixed with the held ones, so that nothing jumps wherever the network begins. Proxies may
be held each by itself (`scene.held_parts`): the network goes on below while any of them is free.

On twos the motion is seen at the frames that are held alone, with straight ways between. A character that is itself
animated on twos would jerk the cloth otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...errors import fail
from ...files import split_location
from ...scene.assets import Deformer, Floats, GarmentPose, Ints, Mesh, Motion, Scene, Skeleton
from ...scene.held import HeldGarment
from ...scene.held_parts import HeldParts, PartShapes, placed_apart, shares_of_group
from ...scene.kinematics import split_at_cuts
from .request import BakeRequest

if TYPE_CHECKING:
    from ssilk_usd.reading.direction import SaidPart

CHUNK = 256  # frames in memory at once
MOSTLY = 0.5  # share of a hand's pose from which on a proxy has to be in it; others may be at rest there

Rolled = Callable[[int, int, int], Iterator[GarmentPose]]


@dataclass(frozen=True, eq=False)
class Direction:
    """How a garment is directed over S samples of a motion.

    Attributes:
        free: 0 where it is held to linear blend skinning, 1 where it moves freely, shape (S,).
        hold: samples that each pose is held.
        motion: the character's, at these samples.
        first: the sample from which held poses are counted.
        parts: where proxies are held each by itself; None where none is.
        shapes: the blendshapes that this takes; None likewise.
        said: what stages say of these parts.
        hand_moves: of proxies that are posed by hand, as for `read_hand_pose`.
    """

    free: Floats
    hold: int
    motion: Motion
    first: int
    parts: HeldParts | None = None
    shapes: PartShapes | None = None
    said: tuple[SaidPart, ...] = ()
    hand_moves: Mapping[str, Floats] = field(default_factory=dict)

    def of(self, deformer: Deformer) -> Direction:
        """Return it with the blendshapes that a garment takes whose proxies are held each by itself."""
        if self.parts is None:
            return self
        free = self.free[:, None] * self.parts.free
        return replace(self, shapes=PartShapes.of(deformer, free, self.free))

    @property
    def moves(self) -> Floats:
        """What the network moves of the proxy that is most free, 0 to 1, shape (S,)."""
        return self.free if self.parts is None else self.free * self.parts.free.max(axis=1, initial=0)

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


def stated_at(mesh: Mesh, stage: str, root: str | None) -> tuple[str, ...]:
    """Return the paths at which stages may direct a garment: that in the character's stage, and of its training."""
    from ssilk_usd.opening.stage import open_stage
    from ssilk_usd.writing.look import look_source

    opened = open_stage(stage)  # prims live as long as it
    there, trained = look_source(mesh, opened, root), split_location(mesh.path)[1]
    found = [*([str(there.prim.GetPath())] if there else []), *([trained] if trained else [])]
    return tuple(dict.fromkeys(found))  # a model may know its garment by a name alone


def need_moving(request: BakeRequest, hold: int) -> None:
    """Raise `SsilkError` where poses are held for some frames that are to be refined."""
    if hold > 1 and request.refine:
        found, allowed = f"poses that are held for {hold} frames, and --refine", "the solver moves each frame"
        fail(request.motion, found, allowed, "leave --refine out, or give --hold 1")


def held_parts(
    said: Sequence[SaidPart],
    deformer: Deformer,
    scene: Scene,
    request: BakeRequest,
    motion: Motion,
    moves: Mapping[str, Floats],
) -> HeldParts:
    """Return how proxies are held each by itself; a proxy's own value comes before those of groups.

    Args:
        scene: of the model, with the proxies' own names, which a target may change.
        motion: the character's, at whose samples they are held.
        moves: as for `read_hand_pose`.

    Raises:
        SsilkError: the model has no proxies, or one is held to a pose by hand that the request's motion has not.
    """
    from ssilk_usd.reading.direction import read_hand_pose

    names, shares, needed = scene.rig.joint_names, list[Floats](), list[str]()
    if not names:
        fail(said[0].where, "a part of a garment without proxies", "parts are held by proxies", "key ssilk:free")
    leaves = np.array([name.rpartition("/")[2] for name in names])
    for posed in (False, True):
        share = np.zeros((motion.frame_count, len(names)))
        asked = [part for part in said if part.posed == posed]
        for part in asked:
            if part.vertices is not None:
                share = np.maximum(share, shares_of_group(deformer, part.vertices) * part.share[:, None])
        for part in asked:
            if part.vertices is None:
                share[:, leaves == part.name] = part.share[:, None]
        needed += [name for name, most in zip(names, share.max(axis=0)) if posed and most > MOSTLY]
        shares.append(share)
    hand = np.tile(np.eye(4), (*shares[1].shape, 1, 1))
    if shares[1].any():
        hand = read_hand_pose(request.motion, scene, motion, request.root, needed, moves)
    return HeldParts(shares[0], shares[1], hand)


def held_proxies(said: Sequence[SaidPart], deformer: Deformer, names: Sequence[str]) -> set[str]:
    """Return the joint paths of the proxies that no smaller model may lack: those that are held by their names, and
    of each group the one that belongs most to it."""
    found = set[str]()
    for part in said:
        if part.vertices is None:
            found |= {name for name in names if name.rpartition("/")[2] == part.name}
        else:
            found.add(names[int(shares_of_group(deformer, part.vertices).argmax())])
    return found


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
        free, apart = self.direction.free[samples], self.direction.parts is not None
        if (free == 1).all() and not apart:
            return self._network(samples, 0, len(samples), not (self.direction.free == 1).all())
        held = self._held_at(samples)
        assert held.translations is not None
        rotations, weights, moved = held.rotations.copy(), held.weights.copy(), held.translations.copy()
        for first, stop in free_stretches(self.direction.moves[samples]):
            part = slice(first, stop)
            mixed = self._network(samples, first, stop, True)
            if not apart:
                mixed = self._held.blended(held.part(part), mixed, free[part])
            rotations[part], weights[part], moved[part] = mixed.rotations, mixed.weights, mixed.translations
        mixed = GarmentPose(0, rotations, weights, moved)
        return self._apart(samples, held, mixed) if apart else mixed

    def _apart(self, samples: Ints, held: GarmentPose, network: GarmentPose) -> GarmentPose:
        """Return the poses at samples (K,) of a garment whose proxies are held each by itself."""
        direction, free, found = self.direction, self.direction.free[samples], []
        assert direction.parts is not None and direction.shapes is not None
        for at in range(0, len(samples), CHUNK):
            part, rows = slice(at, at + CHUNK), samples[at : at + CHUNK]
            base, own = (replace(each.part(part), start=0) for each in (held, network))
            parts = direction.parts.of(partial(np.take, indices=rows, axis=0))
            parts = replace(parts, skinned=1 - free[part, None] * (1 - parts.skinned))
            rotations, moved = placed_apart(self.deformer, direction.motion.picked(rows), base, own, parts)
            away = own.weights.astype(np.float64) - base.weights
            whole = base.weights + free[part, None] * away
            weights = np.concatenate([whole, direction.shapes.weights(away, rows)], axis=1)
            found.append(GarmentPose(at, rotations, weights, moved))
        return GarmentPose.joined(found)

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
            parts, free = self.direction.parts, self.direction.free[rows]
            free = free if parts is None else free * (1 - parts.skinned[rows].max(axis=1, initial=0))
            self.off += off[free < 1].tolist()
            found.append(replace(pose, start=at))
        return GarmentPose.joined(found)
