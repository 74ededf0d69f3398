# SPDX-License-Identifier: GPL-3.0-or-later
"""A trained garment played in Blender with numpy alone, following the armature at any frame of the timeline.

The armature's motion over the scene's frames is read once, a little at a time. Latents are rolled out in blocks, as
far as frames are shown, and kept. A frame therefore looks the same whether it was scrubbed or played to. Where the
armature differs from what was read, latents are kept up to that frame and rolled out again from there.

What was rolled out stands as keys on tracks of its own while it is played. Every evaluation of the file reads these:
renders with an unlocked interface, in other scenes and on farms. Only what differs from them by an edit is written
frame by frame, in the viewport, until the motion is read again.

At a level of quality that is solved for (`solving`), solved frames take the place of the network's as they come in,
and the keys are put once more when all have come.
"""

from __future__ import annotations

import time
from collections.abc import Generator, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import bpy
import numpy as np
from ssilk_usd.shots.skinned import SkinnedGarment

from ssilk_core.delivery.bake.direction import DirectedPoses, Direction
from ssilk_core.errors import SsilkError
from ssilk_core.network.runtime import Playback, Player
from ssilk_core.physics.world.felt import ColliderSight, felt_gravity
from ssilk_core.scene.assets import GarmentPose, Motion
from ssilk_core.scene.held import HeldGarment

from ..arrays.joints import Joints
from ..errors import SetupError
from ..motions.colliders import MetColliders
from ..motions.colliders import signature as met
from ..motions.freedom import freedom, is_held, is_keyed
from ..motions.keys import has_live_keys, need_tracks, remove_keys
from ..motions.nearest import tree_nearest
from ..motions.sampling import SampledTake, motion_of, need_company, prepare_takes, sample, worlds
from ..motions.sources import TIMELINE, Source
from ..motions.world import signature, world_over
from ..scene.armature import read_joints
from ..scene.garment import armature_of
from ..scene.objects import found_again, scene_rate, scene_step
from .bake import (
    animated,
    apply_deformation,
    need_bakeable,
    need_movable,
    proxy_places,
    put_keys,
    shifts_from_rest,
    turns_from_rest,
)
from .fabrics import played_factors
from .family import shape_of
from .laying import Laid
from .models import TrainedGarment
from .solving import SOLVED, Solving, need_solver

BLOCK = 16  # frames rolled at once: few, so that an edit costs little at each frame that follows
PRE_ROLL = 1.0  # seconds in which the garment settles before the first frame, as a bake has it
LOOKING = 16  # frames in which colliders are looked for at once
READING = 0.8  # the part of the preparation that is reading, mostly; the rest is rolling
QUIET = 0.3  # seconds after a pose was found to differ before the motion is solved again
MOVED = 1e-5  # by how much a joint's transform differs that was moved since it was read, of its size


class Live:
    """One garment that is played. In object mode when it begins.

    Attributes:
        done: the part of the motion that was read; None when there is nothing to read.
        stale: whether the armature does something else by now than what was read.
        unkeyed: why what is played stands not as keys, so that renders lack it; empty where it does.
        free: how freely the garment moves in each frame; None where it does throughout, and holds no pose.
        hold: frames that each pose is held.
        world: gravity, wind and colliders that were read; None for the usual gravity and nothing else.
        colliders: that were read; None where the model sees none.
        model_only, fabric_only: whether a newer model, or the model in another fabric, is rolled out for the motion
            that was read before.
        level: of quality, as `GarmentSettings.live_quality` names it.
        solving: what solves for frames; None where the network alone is played.
        unsolved: why nothing does though the level asks for it; empty otherwise.

    Raises:
        SetupError: bones or the garment do not deform as ssilk has it, or nothing can solve at this level.
    """

    def __init__(self, garment: bpy.types.Object, model: Path) -> None:
        armature, self.level = armature_of(garment), garment.ssilk.live_quality
        need_solver(self.level)
        self.joints = read_joints(armature, garment)
        need_bakeable(garment, armature, self.joints)
        self.things = tuple((thing.name, thing.session_uid) for thing in (garment, armature))
        self.model, self.trained, self._written = model, None, 0.0
        self.playback, self.first, self.placed = None, 0, np.zeros((0, 0, 4, 4))
        self.free, self.hold, self.world = None, 1, None
        self.colliders: MetColliders | None = None
        self._laid: Laid | None = None  # how a garment of a family is brought to its body
        self._shape: tuple[object, ...] | None = None  # of the bodies when it was; None for a model of one body
        self._sight: ColliderSight | None = None
        self._near: np.ndarray | None = None  # how near colliders are, (F, M, 5); None where there are none
        self._frames = range(0)
        self.done: float | None = None
        self.stale = self.model_only = self.fabric_only = False
        self.unkeyed = self.unsolved = ""
        self.solving: Solving | None = None
        self._solved_with: tuple[float, ...] = ()  # when the model was written that the solver has, and its fabric
        self._keyed = 0  # solved frames that keys show
        self._noticed: float | None = None  # when a pose differed that the solver does not know yet
        self.refresh()

    def refresh(self) -> None:
        """Read the motion again; the old one is played until that is done."""
        _, armature = self.objects()
        (take,) = prepare_takes(armature, [Source(TIMELINE, "Timeline")])
        self._steps, self.times = self._reading(take), self._asked()
        self.done, self.stale, self.model_only, self.fabric_only = 0.0, False, False, False

    def take_up(self) -> None:
        """Read the model again, for the motion that was read; the old one is played until the new one can be."""
        if self.playback is None or self.stale:
            self.refresh()
        else:
            self._steps, self.done, self.model_only, self.fabric_only = self._taking_up(), 0.0, True, False

    def change_fabric(self) -> None:
        """Roll out what was read in the fabric that is chosen; the old one is played until that is done."""
        if self.playback is None or self.stale:
            self.refresh()
        else:
            self._steps, self.done, self.model_only, self.fabric_only = self._changing(), 0.0, False, True

    @property
    def in_other_fabric(self) -> bool:
        """Whether another fabric is chosen by now than is played."""
        garment, _ = self.objects()
        return self.trained is not None and bool((self.trained.factors != played_factors(garment)).any())

    @property
    def renewed(self) -> bool:
        """Whether the model was written since it was read, as by a training that goes on."""
        return _written(self.model) not in (0.0, self._written)

    @property
    def behind(self) -> bool:
        """Whether the scene's frames, its rate, or how the garment is held are others by now than was read."""
        try:
            return self.times != self._asked() or self._meets_others() or self._has_another_body()
        except SetupError:  # it was deleted, which is told where it is shown
            return False

    def _asked(self) -> tuple[object, ...]:
        """Return what the garment is played over and how, besides what keys say."""
        garment, _ = self.objects()
        own = garment.ssilk.hold, None if is_keyed(garment) else garment.ssilk.free
        return *_times(), *own, *signature(bpy.context.scene)

    def _meets_others(self) -> bool:
        """Return whether the scene has other colliders than were read."""
        return self.colliders is not None and self.colliders.signature != met(*self.objects())

    def _has_another_body(self) -> bool:
        """Return whether the artist has given the character another body since a model of a family was put on it."""
        return self._shape is not None and self._shape != shape_of(*self.objects())

    @property
    def told(self) -> str:
        """What there is to say of the body that it is played on; empty where nothing is."""
        return self.trained.told if self.trained else ""

    def meets_otherwise(
        self, scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph, things: Sequence[bpy.types.Object] | None = None
    ) -> bool:
        """Return whether a collider is evaluated otherwise in this frame than it was read.

        Args:
            things: that may be; all colliders where None.
        """
        if self.colliders is None or self.done is not None or scene != bpy.context.scene:
            return False
        asked = self.colliders.things() if things is None else things
        return self.colliders.differ(asked, depsgraph, scene.frame_current)

    def choose(self, level: str) -> None:
        """Play at another level of quality; where it cannot be solved for, the network is played."""
        self.close()
        self.level = level
        if self.trained:
            self._prepare_solver()
        if self.playback:
            self._follow()
            self.key_again()

    def close(self) -> None:
        """End what runs outside."""
        if self.solving:
            self.solving.close()
        self.solving, self._keyed, self._noticed = None, 0, None

    def solve(self) -> bool:
        """Take in what was solved; return whether more will come."""
        if self.solving is None or self.playback is None:
            return False
        if self._noticed is not None:
            if time.monotonic() - self._noticed < QUIET and not bpy.app.background:
                return True
            self._follow()
        self.solving.poll()
        if self.solving.complete and self._keyed < self.solving.total:
            self.key_again()
        return self.solving.waits

    @property
    def busy(self) -> bool:
        """Whether more is read or solved."""
        return self.done is not None or bool(self.solving and self.solving.waits) or self.noticed

    @property
    def noticed(self) -> bool:
        """Whether a pose was found to differ that the solver does not know yet."""
        return self._noticed is not None

    @property
    def wrong(self) -> str:
        """Why frames are not solved though the level asks for it, in a sentence; empty otherwise."""
        return self.unsolved or (self.solving.error if self.solving else "")

    @property
    def solved(self) -> int:
        """How many frames are solved, from the first one on."""
        return len(self.solving.frames) if self.solving else 0

    def read(self) -> bool:
        """Read a little of the model, then of the motion; return whether there is more.

        Raises:
            SetupError: the model cannot be read, or is of another garment or other bones.
        """
        self.done = next(self._steps, None)
        if self.done is None and self.in_other_fabric:  # a slider is turned meanwhile
            self.change_fabric()
        return self.done is not None

    def objects(self) -> tuple[bpy.types.Object, bpy.types.Object]:
        """Return the garment and its armature; raise `SetupError` if one was deleted."""
        garment, armature = (_found(name, uid) for name, uid in self.things)
        return garment, armature

    def ready(self) -> bool:
        """Return whether the garment may be given other shapes and weights now."""
        garment, _ = self.objects()
        return garment.mode == "OBJECT"

    def is_in(self, scene: bpy.types.Scene) -> bool:
        """Return whether a scene holds the garment; motions are read in one that does not."""
        garment, _ = self.objects()
        return garment.name in scene.objects

    def show(self, scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
        """Put proxies and shape keys where the garment is in this frame, unless keys do; else it is held."""
        if self.playback is None or not self.is_in(scene):
            return
        garment, armature = self.objects()
        self._need_bones(garment, armature)
        if self._lost_shapes(garment):  # as an undo takes them away, before it is told
            self.dress_again()
            return
        index = min(max(scene.frame_current - self.first, 0), len(self.placed) - 1)
        if index == scene.frame_current - self.first:
            self._take_notice(armature.evaluated_get(depsgraph), index)
        if not self.stale and not self.unkeyed and not self._keyed <= index < self.solved:
            return
        pose = self.solving.frames[index] if index < self.solved else self._pose(index)
        rotations = pose.rotations[:, self.trained.proxies]
        turns = turns_from_rest(self.joints, rotations)[0]
        for name, turn in zip(self.joints.proxies, turns.tolist()):
            armature.pose.bones[name].rotation_quaternion = turn
        places = proxy_places(self.joints, rotations, pose, self.trained.proxies, self._laid)
        if places is not None:
            shifts = shifts_from_rest(armature, self.joints, places)[0]
            for name, shift in zip(self.joints.proxies, shifts.tolist()):
                armature.pose.bones[name].location = shift
        blocks = garment.data.shape_keys.key_blocks if self.shapes else ()
        for name, weight in zip(self.shapes, pose.weights[0].tolist()):
            blocks[name].value = weight

    def _pose(self, index: int) -> GarmentPose:
        """Return the pose of a frame whose motion was edited since it was read."""
        if self.free is None:
            return self.playback.pose(index)
        index -= index % self.hold
        if self.free[index] == 1:
            return self.playback.pose(index)
        held, _ = self._held.pose(self._motion(self.trained, self.placed[index : index + 1]))
        return self._held.blended(held, self.playback.pose(index), self.free[index : index + 1])

    def disagrees(self, scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> bool:
        """Return whether an evaluated frame shows another pose than what was read, or none that was."""
        if self.playback is None or not self.is_in(scene):
            return False
        _, armature = self.objects()
        index = scene.frame_current - self.first
        inside = 0 <= index < len(self.placed)
        return not inside or not self._is_as_read(self._placed(armature.evaluated_get(depsgraph)), index)

    def missing(self) -> bool:
        """Return whether shapes or keys are not there any more, as after an undo."""
        garment, armature = self.objects()
        if self.playback is None:
            return False
        bones = armature.pose.bones
        lost = self._lost_shapes(garment) or any(name not in bones for name in self.joints.names)
        return lost or not (self.unkeyed or has_live_keys(garment, self._moved(garment, armature)))

    def dress_again(self) -> None:
        """Give the garment its shapes, weights and keys once more."""
        self.trained = self.playback = None
        self.refresh()

    def _moved(self, garment: bpy.types.Object, armature: bpy.types.Object) -> list[object]:
        keys = garment.data.shape_keys
        return [armature, *([keys] if self.shapes and keys else [])]

    def _key(self, poses: Iterable[GarmentPose], first: int) -> None:
        """Let keys show what was solved, and what was rolled out after it."""
        garment, armature = self.objects()
        try:
            need_tracks(animated(garment, armature))
        except SetupError as error:  # the artist tweaks a strip: it is played nevertheless
            self.unkeyed = str(error)
            return
        self.unkeyed, self._keyed = "", self.solved
        solved = self.solving.frames if self.solving else []
        after = [pose.part(slice(max(self._keyed - pose.start, 0), None)) for pose in poses]
        shown = GarmentPose.joined([*solved, *after])
        proxies, laid = self.trained.proxies, self._laid
        put_keys(garment, armature, self.joints, proxies, self.shapes, shown, first, live=True, laid=laid)

    def key_again(self) -> None:
        """Let keys show what is known by now, as after an undo, which may have brought back those of before."""
        if self.playback and not self.stale:
            self._key(self.playback.poses() if self.solved < len(self.placed) else (), self.first)

    def _prepare_solver(self) -> None:
        """Prepare what solves for frames with the model that was read last, where the level asks for it."""
        asked = self._written, *self.trained.factors.tolist()
        if self.solving and self._solved_with == asked:
            return
        self.close()
        self.unsolved, self._solved_with = "", asked
        if self.level not in SOLVED:
            return
        try:
            garment, armature = self.objects()
            if not self.ready():
                raise SetupError(f"'{garment.name}' is not in Object Mode; go there and choose the quality again.")
            self.solving = Solving(garment, armature, self.model, self.trained, self.level, PRE_ROLL)
        except SsilkError as error:
            self.unsolved = str(error)

    def _follow(self) -> None:
        """Let the solver follow the motion as it is known by now."""
        self._noticed = None
        if self.solving and self.free is not None:
            self.close()
            self.unsolved = "A garment that is held is played by the network; a bake at this quality solves for it."
        if self.solving:
            self.solving.follow(self._motion(self.trained, self.placed))
            self._keyed = min(self._keyed, self.solved)

    def _need_bones(self, garment: bpy.types.Object, armature: bpy.types.Object) -> None:
        """Check that no bone that is read or written to was deleted or renamed."""
        lost = next((name for name in self.joints.names if name not in armature.pose.bones), None)
        if lost is not None:
            raise SetupError(
                f"The bone '{lost}' of '{armature.name}' was deleted or renamed while '{garment.name}' was played; "
                "play it again."
            )

    def _lost_shapes(self, garment: bpy.types.Object) -> bool:
        keys = garment.data.shape_keys
        return any(not keys or name not in keys.key_blocks for name in self.shapes)

    def _reading(self, take: SampledTake) -> Iterator[float]:
        """Read the motion, then roll over it, so that scrubbing waits for nothing; yield the part that is done."""
        if self.trained is None or self.renewed or self._has_another_body():
            yield from self._dressing()
        garment, armature = self.objects()
        if self.in_other_fabric:
            self.trained = self.trained.in_fabric(garment)
        yield from (READING * done for done in sample(armature, self.joints.character, [take]))
        garment, armature = self.objects()
        need_company(garment, armature, take)
        placed, self.hold, free = np.array(take.worlds), garment.ssilk.hold, freedom(garment, take.frames)
        self.free = free if self.hold > 1 or (free < 1).any() else None
        self.colliders = yield from self._meeting(self.trained, take.frames)
        self._frames, sight = take.frames, self._surround(self.trained, take.frames)
        if is_held(garment):
            need_movable(armature, self.joints.proxies)
        near = yield from self._looking(self.trained, placed, sight)
        playback, poses = yield from self._rolling(self.trained, placed, near, READING)
        self.first, self.placed, self.playback = take.frames.start, placed, playback
        self._near, self._sight = near, sight
        self._prepare_solver()
        self._follow()
        self._key(poses, self.first)

    def _meeting(self, trained: TrainedGarment, frames: range) -> Generator[float, None, MetColliders | None]:
        """Return the colliders over frames of the timeline; None for a model that sees none."""
        if not trained.sees_colliders:
            return None
        read = MetColliders(*self.objects(), frames)
        if self.colliders:
            read.remember(self.colliders)
        yield from (READING for _ in read.sample())
        return read

    def _surround(self, trained: TrainedGarment, frames: range) -> ColliderSight | None:
        """Take what was read as what surrounds the character from now on; return what a model sees of it."""
        found = self.colliders.found if self.colliders else ()
        self.world = world_over(bpy.context.scene, frames, scene_rate(), found)
        return trained.sight(self.world, tree_nearest) if self.world and found else None

    def _looking(
        self, trained: TrainedGarment, placed: np.ndarray, sight: ColliderSight | None
    ) -> Generator[float, None, np.ndarray | None]:
        """Return how near colliders are to the garment in each frame, (F, M, 5); None where there are none."""
        if sight is None:
            return None
        motion, found = self._motion(trained, placed), []
        for first in range(0, len(placed), LOOKING):
            found.append(sight.near(motion, np.arange(first, min(first + LOOKING, len(placed)))))
            yield READING
        return np.concatenate(found)

    def _rolling(
        self, trained: TrainedGarment, placed: np.ndarray, near: np.ndarray | None, done: float
    ) -> Generator[float, None, tuple[Playback, list[GarmentPose]]]:
        """Return what plays joints to the world, (F, J, 4, 4), with all poses; yield the part that is done."""
        motion, player, poses = self._motion(trained, placed, near), trained.player, []
        playback, some = player.play(motion, pre_roll=PRE_ROLL, block=BLOCK), None
        if self.free is not None:
            deformer = player.deformer()
            self._held, direction = HeldGarment(deformer), Direction(self.free, self.hold, motion, 0)
            some = DirectedPoses(direction, deformer, partial(_rolled, player, motion)).poses(0, len(placed))
        for pose in playback.poses() if some is None else some:
            poses.append(pose)
            yield done + (1 - done) * pose.start / len(placed)
        return playback, poses

    def _motion(self, trained: TrainedGarment, placed: np.ndarray, near: np.ndarray | None = None) -> Motion:
        """Return joints of the armature to the world, shape (F, J, 4, 4), as a motion of the model's skeleton.

        Args:
            near: how near colliders are, shape (F, M, 5).
        """
        player = trained.player
        motion = motion_of(placed[:, trained.own], player.skeleton.parents, "the timeline")
        if near is not None:
            motion = replace(motion, proximity=near)
        if player.file.config.descriptors != "relative":  # it names the axes of the world, as `ssilk bake` has it
            return motion
        return replace(motion, gravity=felt_gravity(self.world, motion, player.file.scene, player.file.fabric))

    def _trained(self) -> TrainedGarment:
        """Read the model, and check that the bones move as it says."""
        garment, armature = self.objects()
        trained = TrainedGarment(self.model, garment, armature, read_joints(armature, garment))
        if trained.player.file.config.translations:
            need_movable(armature, self.joints.proxies)
        return trained

    def _taking_up(self) -> Iterator[float]:
        """Read the model and roll it out, then give the garment its shapes and weights and play it at once."""
        written, trained, placed = _written(self.model), self._trained(), self.placed.copy()
        yield 0.0
        skinned = SkinnedGarment.of(trained.player.deformer())
        if trained.sees_colliders != (self.colliders is not None):
            self.colliders = yield from self._meeting(trained, self._frames)
        sight = self._surround(trained, self._frames)
        near = yield from self._looking(trained, placed, sight)
        playback, poses = yield from self._rolling(trained, placed, near, 0.0)
        garment, armature = self.objects()
        if not self.ready():  # the artist edits it; the model is still a new one afterwards
            return
        self.joints = self._joints_now()
        near, playback = self._moved_since(trained, placed, near, sight, playback)
        laid = trained.lay(garment, armature, self.joints, skinned)
        self.shapes = apply_deformation(garment, armature, self.joints, skinned, trained.order, laid)
        self._laid, self._shape = laid, shape_of(garment, armature) if trained.on else None
        self._written = written
        self._play(trained, playback, near, sight, poses)

    def _changing(self) -> Iterator[float]:
        """Roll the motion out in another fabric, then play that at once; shapes and weights are the same."""
        garment, _ = self.objects()
        trained, placed = self.trained.in_fabric(garment), self.placed.copy()
        yield 0.0
        sight = self._surround(trained, self._frames)
        near = yield from self._looking(trained, placed, sight)
        playback, poses = yield from self._rolling(trained, placed, near, 0.0)
        near, playback = self._moved_since(trained, placed, near, sight, playback)
        self._play(trained, playback, near, sight, poses)

    def _moved_since(
        self, trained: TrainedGarment, placed: np.ndarray, near: np.ndarray | None, sight: ColliderSight | None,
        playback: Playback,
    ) -> tuple[np.ndarray | None, Playback]:  # fmt: skip
        """Return proximity and what plays, where the artist has moved the armature since it was `placed`."""
        moved = np.flatnonzero((placed != self.placed).any(axis=(1, 2, 3)))
        if not len(moved):
            return near, playback
        near = self._near_again(trained, near, moved, sight)
        return near, playback.with_motion(self._motion(trained, self.placed, near), int(moved[0]))

    def _play(
        self, trained: TrainedGarment, playback: Playback, near: np.ndarray | None, sight: ColliderSight | None,
        poses: list[GarmentPose],
    ) -> None:  # fmt: skip
        """Play what was rolled out from now on."""
        self.trained, self.playback, self._near, self._sight = trained, playback, near, sight
        self._prepare_solver()
        self._follow()
        self._key(poses, self.first)

    def _dressing(self) -> Iterator[float]:
        """Read the model and give the garment its shapes and weights; it is held until it is played by them."""
        self._written = _written(self.model)
        trained = self._trained()
        yield 0.0
        skinned = SkinnedGarment.of(trained.player.deformer())
        yield 0.0
        garment, armature = self.objects()
        if not self.ready():
            raise SetupError(f"'{garment.name}' left Object Mode while its model was read; play it again.")
        self.joints = self._joints_now()
        laid = trained.lay(garment, armature, self.joints, skinned)
        self.shapes = apply_deformation(garment, armature, self.joints, skinned, trained.order, laid)
        self._laid, self._shape = laid, shape_of(garment, armature) if trained.on else None
        self.trained, self.playback = trained, None
        self._prepare_solver()
        yield 0.0

    def _joints_now(self) -> Joints:
        """Return the joints where the armature, which may move as an object, has them in this frame."""
        garment, armature = self.objects()
        joints = read_joints(armature, garment)
        if joints.names != self.joints.names or not np.array_equal(joints.parents, self.joints.parents):
            raise SetupError(
                f"Bones of '{armature.name}' were changed while '{garment.name}' was played; play it again."
            )
        return joints

    def _take_notice(self, armature: bpy.types.Object, index: int) -> None:
        """Roll out again from a pose that differs from the one that was read."""
        placed = self._placed(armature)
        if self._is_as_read(placed, index):
            return
        self.placed[index] = placed
        self._near = self._near_again(self.trained, self._near, np.array([index]), self._sight)
        motion = self._motion(self.trained, self.placed, self._near)
        self.playback, self.stale = self.playback.with_motion(motion, index), True
        if self.solving:
            self.solving.forget_from(index)
            self._keyed, self._noticed = min(self._keyed, self.solved), time.monotonic()

    def _near_again(
        self, trained: TrainedGarment, near: np.ndarray | None, frames: np.ndarray, sight: ColliderSight | None
    ) -> np.ndarray | None:
        """Return how near colliders are, (F, M, 5), where the armature differs in some frames by now."""
        if near is None or sight is None:
            return None
        near = near.copy()
        near[frames] = sight.near(self._motion(trained, self.placed), frames)
        return near

    def _placed(self, armature: bpy.types.Object) -> np.ndarray:
        bones = [armature.pose.bones.find(name) for name in self.joints.character.names]
        return worlds(armature)[bones]

    def _is_as_read(self, placed: np.ndarray, index: int) -> bool:
        return bool(np.allclose(placed, self.placed[index], rtol=MOVED, atol=MOVED))


def remove_live_keys(garment: bpy.types.Object) -> None:
    """Remove the keys that stand for live playback of a garment, wherever they are."""
    own = (thing for things in (bpy.data.objects, bpy.data.shape_keys) for thing in things)
    remove_keys(garment, [thing for thing in own if not thing.library], live=True)


def _times() -> tuple[int, int, float, float]:
    scene = bpy.context.scene
    return scene.frame_start, scene.frame_end, scene_rate(), scene_step()


def _rolled(player: Player, motion: Motion, first: int, stop: int, step: int) -> Iterator[GarmentPose]:
    """Yield the network's poses at frames first, first + step, ..., below stop; the motion is straight in between."""
    seen = slice(first, stop, step)
    part = motion.picked(seen)
    part = replace(part, fps=motion.fps / step, start=0.0)
    return player.play(part, pre_roll=PRE_ROLL, block=BLOCK).poses()


def _written(path: Path) -> float:
    """Return when a file was written; zero where there is none."""
    return path.stat().st_mtime if path.is_file() else 0.0


def _found(name: str, uid: int) -> bpy.types.Object:
    """Return an object, mostly by its name, which is fast; raise `SetupError` if it was deleted."""
    thing = bpy.data.objects.get(name)
    return thing if thing and thing.session_uid == uid else found_again(uid, name)
