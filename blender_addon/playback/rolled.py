# SPDX-License-Identifier: GPL-3.0-or-later
"""The network rolled over what was read of the armature's motion, and again from where the armature differs."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from ssilk_core.delivery.bake.direction import DirectedPoses, Direction
from ssilk_core.network.runtime import Playback, Player
from ssilk_core.physics.world.felt import ColliderSight, felt_gravity
from ssilk_core.scene.assets import GarmentPose, Motion, ShotWorld
from ssilk_core.scene.held import HeldGarment

from ..motions.sampling import motion_of
from .models import TrainedGarment

BLOCK = 16  # frames rolled at once: few, so that an edit costs little at each frame that follows
PRE_ROLL = 1.0  # seconds in which the garment settles before the first frame, as a bake has it
LOOKING = 16  # frames in which colliders are looked for at once
MOVED = 1e-5  # by how much a joint's transform differs that was moved since it was read, of its size


class RolledMotion:
    """A trained garment over frames of the timeline.

    Attributes:
        frames: of the timeline.
        placed: joints of the armature to the world, as they were read or found since, shape (F, J, 4, 4).
        near: how near colliders are, (F, M, 5); None where there are none.

    Args:
        free: how freely the garment moves in each frame; None where it does throughout, and holds no pose.
        hold: frames that each pose is held.
        world: gravity, wind and colliders; None for the usual gravity and nothing else.
        sight: what the model sees of the colliders; None for none.
    """

    def __init__(
        self, trained: TrainedGarment, frames: range, placed: np.ndarray, free: np.ndarray | None, hold: int,
        world: ShotWorld | None, sight: ColliderSight | None,
    ) -> None:  # fmt: skip
        self.trained, self.frames, self.placed = trained, frames, placed
        self.free, self.hold = free, hold
        self._world, self._sight = world, sight
        self.near: np.ndarray | None = None
        self._playback: Playback | None = None  # until `roll` has come to its end
        self._held: HeldGarment | None = None

    def in_other(self, trained: TrainedGarment, world: ShotWorld | None, sight: ColliderSight | None) -> RolledMotion:
        """Return the same motion, still to be rolled out, for another model or in another fabric."""
        return RolledMotion(trained, self.frames, self.placed.copy(), self.free, self.hold, world, sight)

    def roll(self, done: float) -> Generator[float, None, list[GarmentPose]]:
        """Return all poses; yield the part of the work that is done, of which so much was before."""
        if self._sight is not None:
            motion, found = self.motion(), []
            for first in range(0, len(self.placed), LOOKING):
                found.append(self._sight.near(motion, np.arange(first, min(first + LOOKING, len(self.placed)))))
                yield done
            self.near = np.concatenate(found)
        motion, player, poses = self._seen(), self.trained.player, []
        self._playback, some = player.play(motion, pre_roll=PRE_ROLL, block=BLOCK), None
        if self.free is not None:
            deformer = player.deformer()
            self._held, direction = HeldGarment(deformer), Direction(self.free, self.hold, motion, 0)
            some = DirectedPoses(direction, deformer, partial(_rolled, player, motion)).poses(0, len(self.placed))
        for pose in self._playback.poses() if some is None else some:
            poses.append(pose)
            yield done + (1 - done) * pose.start / len(self.placed)
        return poses

    def motion(self) -> Motion:
        """Return the motion of the model's skeleton, which knows of no colliders."""
        motion, file = self._of_skeleton(slice(None)), self.trained.player.file
        if file.config.descriptors != "relative":  # it names the axes of the world, as `ssilk bake` has it
            return motion
        return replace(motion, gravity=felt_gravity(self._world, motion, file.scene, file.fabric))

    def _seen(self) -> Motion:
        """Return the motion with how near colliders are, where there are any."""
        motion = self.motion()
        return motion if self.near is None else replace(motion, proximity=self.near)

    def _of_skeleton(self, frames: slice) -> Motion:
        placed = self.placed[frames, self.trained.own]
        return motion_of(placed, self.trained.player.skeleton.parents, "the timeline")

    def poses(self) -> Iterator[GarmentPose]:
        """Yield the network's poses, some frames at a time."""
        return self._played.poses()

    def pose(self, index: int) -> GarmentPose:
        """Return the pose of a frame whose motion was edited since it was read."""
        if self.free is None:
            return self._played.pose(index)
        index -= index % self.hold
        if self.free[index] == 1:
            return self._played.pose(index)
        assert self._held is not None
        held, _ = self._held.pose(self._of_skeleton(slice(index, index + 1)))
        return self._held.blended(held, self._played.pose(index), self.free[index : index + 1])

    def is_as_known(self, placed: np.ndarray, index: int) -> bool:
        """Return whether joints (J, 4, 4) are where the motion has them in a frame."""
        return bool(np.allclose(placed, self.placed[index], rtol=MOVED, atol=MOVED))

    def differs(self, placed: np.ndarray, index: int) -> None:
        """Roll out again from a frame in which joints are elsewhere, (J, 4, 4)."""
        self.placed[index] = placed
        self._roll_again(np.array([index]))

    def move_to(self, placed: np.ndarray) -> None:
        """Take over joints (F, J, 4, 4), and roll out again from where they differ."""
        moved = np.flatnonzero((self.placed != placed).any(axis=(1, 2, 3)))
        self.placed = placed
        if len(moved):
            self._roll_again(moved)

    def _roll_again(self, frames: np.ndarray) -> None:
        if self.near is not None and self._sight is not None:
            self.near = self.near.copy()  # the motion that is played still has the other
            self.near[frames] = self._sight.near(self.motion(), frames)
        self._playback = self._played.with_motion(self._seen(), int(frames[0]))

    @property
    def _played(self) -> Playback:
        assert self._playback is not None
        return self._playback


def _rolled(player: Player, motion: Motion, first: int, stop: int, step: int) -> Iterator[GarmentPose]:
    """Yield the network's poses at frames first, first + step, ..., below stop; the motion is straight in between."""
    seen = slice(first, stop, step)
    part = motion.picked(seen)
    part = replace(part, fps=motion.fps / step, start=0.0)
    return player.play(part, pre_roll=PRE_ROLL, block=BLOCK).poses()
