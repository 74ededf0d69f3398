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

from collections.abc import Generator, Iterable, Iterator, Sequence
from pathlib import Path

import bpy
import numpy as np
from ssilk_usd.shots.skinned import SkinnedGarment

from ssilk_core.physics.world.felt import ColliderSight
from ssilk_core.scene.assets import GarmentPose, ShotWorld

from ..errors import SetupError
from ..motions.colliders import MetColliders
from ..motions.colliders import signature as met
from ..motions.freedom import freedom, is_held, is_keyed
from ..motions.nearest import tree_nearest
from ..motions.sampling import SampledTake, need_company, prepare_takes, sample
from ..motions.sources import TIMELINE, Source
from ..motions.world import signature, world_over
from ..scene.armature import read_joints
from ..scene.garment import armature_of
from ..scene.objects import scene_rate, scene_step
from .bake import need_movable
from .dressed import DressedGarment
from .fabrics import played_factors
from .models import TrainedGarment
from .rolled import RolledMotion
from .solved import SolvedFrames
from .solving import Solving

READING = 0.8  # the part of the preparation that is reading, mostly; the rest is rolling


class Live:
    """One garment that is played. In object mode when it begins.

    Attributes:
        dressed: the garment, on which poses are put.
        rolled: what the network plays; None until it can.
        solver: what is solved in its place.
        done: the part of the motion that was read; None when there is nothing to read.
        stale: whether the armature does something else by now than what was read.
        unkeyed: why what is played stands not as keys, so that renders lack it; empty where it does.
        colliders: that were read; None where the model sees none.
        model_only, fabric_only: whether a newer model, or the model in another fabric, is rolled out for the motion
            that was read before.

    Raises:
        SetupError: bones or the garment do not deform as ssilk has it, or nothing can solve at this level.
    """

    def __init__(self, garment: bpy.types.Object, model: Path) -> None:
        armature = armature_of(garment)
        self.solver = SolvedFrames(garment.ssilk.live_quality)
        self.dressed = DressedGarment(garment, armature)
        self.model, self.written = model, 0.0  # when the model was written that was read last
        self.trained: TrainedGarment | None = None
        self.rolled: RolledMotion | None = None
        self.first = 0
        self.colliders: MetColliders | None = None
        self.done: float | None = None
        self.stale = self.model_only = self.fabric_only = False
        self.unkeyed = ""
        self.refresh()

    def refresh(self) -> None:
        """Read the motion again; the old one is played until that is done."""
        _, armature = self.dressed.objects()
        (take,) = prepare_takes(armature, [Source(TIMELINE, "Timeline")])
        self._steps, self.times = self._reading(take), self._asked()
        self.done, self.stale, self.model_only, self.fabric_only = 0.0, False, False, False

    def take_up(self) -> None:
        """Read the model again, for the motion that was read; the old one is played until the new one can be."""
        if self.rolled is None or self.stale:
            self.refresh()
        else:
            self._steps, self.done, self.model_only, self.fabric_only = self._taking_up(self.rolled), 0.0, True, False

    def change_fabric(self) -> None:
        """Roll out what was read in the fabric that is chosen; the old one is played until that is done."""
        if self.rolled is None or self.stale:
            self.refresh()
        else:
            self._steps, self.done, self.model_only, self.fabric_only = self._changing(self.rolled), 0.0, False, True

    def read(self) -> bool:
        """Read a little of the model, then of the motion; return whether there is more.

        Raises:
            SetupError: the model cannot be read, or is of another garment or other bones.
        """
        self.done = next(self._steps, None)
        if self.done is None and self.in_other_fabric:  # a slider is turned meanwhile
            self.change_fabric()
        return self.done is not None

    @property
    def in_other_fabric(self) -> bool:
        """Whether another fabric is chosen by now than is played."""
        garment, _ = self.dressed.objects()
        return self.trained is not None and bool((self.trained.factors != played_factors(garment)).any())

    @property
    def renewed(self) -> bool:
        """Whether the model was written since it was read, as by a training that goes on."""
        return _written(self.model) not in (0.0, self.written)

    @property
    def behind(self) -> bool:
        """Whether the scene's frames, its rate, or how the garment is held are others by now than was read."""
        try:
            return self.times != self._asked() or self._meets_others() or self.dressed.has_another_body()
        except SetupError:  # it was deleted, which is told where it is shown
            return False

    def _asked(self) -> tuple[object, ...]:
        """Return what the garment is played over and how, besides what keys say."""
        garment, _ = self.dressed.objects()
        own = garment.ssilk.hold, None if is_keyed(garment) else garment.ssilk.free
        scene = bpy.context.scene
        return scene.frame_start, scene.frame_end, scene_rate(), scene_step(), *own, *signature(scene)

    def _meets_others(self) -> bool:
        """Return whether the scene has other colliders than were read."""
        return self.colliders is not None and self.colliders.signature != met(*self.dressed.objects())

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

    @property
    def solving(self) -> Solving | None:
        """What solves for frames; None where the network alone is played."""
        return self.solver.solving

    @property
    def solved(self) -> int:
        """How many frames are solved, from the first one on."""
        return len(self.solver.frames)

    @property
    def wrong(self) -> str:
        """Why frames are not solved though the level asks for it, in a sentence; empty otherwise."""
        return self.solver.wrong

    @property
    def busy(self) -> bool:
        """Whether more is read or solved."""
        return self.done is not None or self.solver.waits

    def choose(self, level: str) -> None:
        """Play at another level of quality; where it cannot be solved for, the network is played."""
        self.solver.close()
        self.solver.level = level
        if self.trained:
            self.solver.prepare(self.dressed, self.model, self.trained, self.written)
        if self.rolled:
            self.solver.follow(self.rolled)
            self.key_again()

    def solve(self) -> bool:
        """Take in what was solved; return whether more will come."""
        if self.solving is None or self.rolled is None:
            return False
        if self.solver.take_in(self.rolled):
            self.key_again()
        return self.solver.waits

    def show(self, scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
        """Put proxies and shape keys where the garment is in this frame, unless keys do; else it is held."""
        dressed, rolled = self.dressed, self.rolled
        if rolled is None or not dressed.is_in(scene):
            return
        dressed.need_bones()
        if dressed.has_lost_shapes():  # as an undo takes them away, before it is told
            self.dress_again()
            return
        index = min(max(scene.frame_current - self.first, 0), len(rolled.placed) - 1)
        if index == scene.frame_current - self.first:
            self._take_notice(rolled, dressed.placed(depsgraph), index)
        if self.stale or self.unkeyed or self.solver.keyed <= index < self.solved:
            pose = self.solver.frames[index] if index < self.solved else rolled.pose(index)
            dressed.put(pose, rolled.trained.proxies)

    def _take_notice(self, rolled: RolledMotion, placed: np.ndarray, index: int) -> None:
        """Roll out again from a pose that differs from the one that was read."""
        if not rolled.is_as_known(placed, index):
            rolled.differs(placed, index)
            self.stale = True
            self.solver.forget_from(index)

    def disagrees(self, scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> bool:
        """Return whether an evaluated frame shows another pose than what was read, or none that was."""
        if self.rolled is None or not self.dressed.is_in(scene):
            return False
        index = scene.frame_current - self.first
        inside = 0 <= index < len(self.rolled.placed)
        return not inside or not self.rolled.is_as_known(self.dressed.placed(depsgraph), index)

    def missing(self) -> bool:
        """Return whether shapes or keys are not there any more, as after an undo."""
        if self.rolled is None:
            return False
        lost = self.dressed.has_lost_shapes() or self.dressed.lost_bone() is not None
        return lost or not (self.unkeyed or self.dressed.has_keys())

    def dress_again(self) -> None:
        """Give the garment its shapes, weights and keys once more."""
        self.trained = self.rolled = None
        self.refresh()

    def key_again(self) -> None:
        """Let keys show what is known by now, as after an undo, which may have brought back those of before."""
        if self.rolled and not self.stale:
            self._key(self.rolled.poses() if self.solved < len(self.rolled.placed) else ())

    def _key(self, poses: Iterable[GarmentPose]) -> None:
        """Let keys show what was solved, and what was rolled out after it."""
        try:
            self.dressed.need_tracks()
        except SetupError as error:  # the artist tweaks a strip: it is played nevertheless
            self.unkeyed = str(error)
            return
        self.unkeyed, self.solver.keyed = "", self.solved
        after = [pose.part(slice(max(self.solved - pose.start, 0), None)) for pose in poses]
        shown = GarmentPose.joined([*self.solver.frames, *after])
        assert self.trained is not None
        self.dressed.put_keys(shown, self.first, self.trained.proxies)

    def _reading(self, take: SampledTake) -> Iterator[float]:
        """Read the motion, then roll over it, so that scrubbing waits for nothing; yield the part that is done."""
        if self.trained is None or self.renewed or self.dressed.has_another_body():
            yield from self._dressing()
        assert self.trained is not None
        garment, armature = self.dressed.objects()
        if self.in_other_fabric:
            self.trained = self.trained.in_fabric(garment)
        yield from (READING * done for done in sample(armature, self.dressed.joints.character, [take]))
        garment, armature = self.dressed.objects()
        need_company(garment, armature, take)
        placed, hold, free = np.array(take.worlds), garment.ssilk.hold, freedom(garment, take.frames)
        self.colliders = yield from self._meeting(self.trained, take.frames)
        around = self._surroundings(self.trained, take.frames)
        if is_held(garment):
            need_movable(armature, self.dressed.joints.proxies)
        directed = free if hold > 1 or (free < 1).any() else None
        rolled = RolledMotion(self.trained, take.frames, placed, directed, hold, *around)
        self._play(rolled, (yield from rolled.roll(READING)))

    def _taking_up(self, before: RolledMotion) -> Iterator[float]:
        """Read the model and roll it out, then give the garment its shapes and weights and play it at once."""
        written, trained = _written(self.model), self._trained()
        yield 0.0
        skinned = SkinnedGarment.of(trained.player.deformer())
        if trained.sees_colliders != (self.colliders is not None):
            self.colliders = yield from self._meeting(trained, before.frames)
        rolled = before.in_other(trained, *self._surroundings(trained, before.frames))
        poses = yield from rolled.roll(0.0)
        if not self.dressed.ready():  # the artist edits it; the model is still a new one afterwards
            return
        self.dressed.dress(trained, skinned)
        self.written = written
        rolled.move_to(before.placed)  # which the artist may have moved on since
        self._play(rolled, poses)

    def _changing(self, before: RolledMotion) -> Iterator[float]:
        """Roll the motion out in another fabric, then play that at once; shapes and weights are the same."""
        trained = before.trained.in_fabric(self.dressed.objects()[0])
        yield 0.0
        rolled = before.in_other(trained, *self._surroundings(trained, before.frames))
        poses = yield from rolled.roll(0.0)
        rolled.move_to(before.placed)
        self._play(rolled, poses)

    def _play(self, rolled: RolledMotion, poses: list[GarmentPose]) -> None:
        """Play what was rolled out from now on."""
        self.trained, self.rolled, self.first = rolled.trained, rolled, rolled.frames.start
        self.solver.prepare(self.dressed, self.model, rolled.trained, self.written)
        self.solver.follow(rolled)
        self._key(poses)

    def _dressing(self) -> Iterator[float]:
        """Read the model and give the garment its shapes and weights; it is held until it is played by them."""
        self.written = _written(self.model)
        trained = self._trained()
        yield 0.0
        skinned = SkinnedGarment.of(trained.player.deformer())
        yield 0.0
        garment, _ = self.dressed.objects()
        if not self.dressed.ready():
            raise SetupError(f"'{garment.name}' left Object Mode while its model was read; play it again.")
        self.dressed.dress(trained, skinned)
        self.trained, self.rolled = trained, None
        self.solver.prepare(self.dressed, self.model, trained, self.written)
        yield 0.0

    def _trained(self) -> TrainedGarment:
        """Read the model, and check that the bones move as it says."""
        garment, armature = self.dressed.objects()
        trained = TrainedGarment(self.model, garment, armature, read_joints(armature, garment))
        if trained.player.file.config.translations:
            need_movable(armature, self.dressed.joints.proxies)
        return trained

    def _meeting(self, trained: TrainedGarment, frames: range) -> Generator[float, None, MetColliders | None]:
        """Return the colliders over frames of the timeline; None for a model that sees none."""
        if not trained.sees_colliders:
            return None
        read = MetColliders(*self.dressed.objects(), frames)
        if self.colliders:
            read.remember(self.colliders)
        yield from (READING for _ in read.sample())
        return read

    def _surroundings(self, trained: TrainedGarment, frames: range) -> tuple[ShotWorld | None, ColliderSight | None]:
        """Return what surrounds the character over frames of the timeline, and what a model sees of it."""
        found = self.colliders.found if self.colliders else ()
        world = world_over(bpy.context.scene, frames, scene_rate(), found)
        return world, trained.sight(world, tree_nearest) if world and found else None


def _written(path: Path) -> float:
    """Return when a file was written; zero where there is none."""
    return path.stat().st_mtime if path.is_file() else 0.0
