# SPDX-License-Identifier: GPL-3.0-or-later
"""Baking a trained garment onto the timeline, to USD, or both."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from bpy.props import BoolProperty, EnumProperty, FloatProperty, StringProperty
from ssilk_usd.names import LAYER_SUFFIXES

from ssilk_core.errors import SsilkError
from ssilk_core.files import split_location
from ssilk_core.network.checkpoint import load_model
from ssilk_core.quality.levels import QUALITIES
from ssilk_core.scene.assets import PINNED, TIGHT, Collider

from ..arrays.joints import Joints, joint_order
from ..arrays.renamed import TrainedJoints, known_as
from ..errors import SetupError
from ..motions.colliders import MetColliders, left_out, unseen
from ..motions.freedom import freedom, is_held
from ..motions.held import HeldBones
from ..motions.keys import has_keys, need_tracks
from ..motions.sampling import SampledTake, need_company, prepare_takes, sample
from ..motions.shapes import tell_changing_shapes
from ..motions.simulated import sample_vertices
from ..motions.sources import TIMELINE, Source
from ..motions.world import world_over
from ..outside.wording import recall, reworded, with_bones
from ..outside.work import Work
from ..playback import playing
from ..playback.bake import animated, apply_bake, need_bakeable, need_movable, remove_bake
from ..playback.beneath import ShownBeneath
from ..playback.bodies import corrected, reshaped
from ..playback.fabrics import friction_options, played_options
from ..playback.family import BodyModel, on_its_body
from ..playback.followed import SampledKeys, followed_bodies
from ..playback.models import (
    chosen_bones,
    joints_known_to,
    model_of,
    no_model,
    told_renames,
    trainings_folder,
)
from ..playback.overrides import overriding, told
from ..preferences import interpreter, no_certificates, preferences, unready
from ..scene.armature import read_joints
from ..scene.classes import current_classes
from ..scene.garment import armature_of, bodies_of, unplayable_here
from ..scene.gather import ROOT, gather
from ..scene.handover import STAGE, hand_over, loading_usd
from ..scene.linked import is_override
from ..scene.look import left_behind, lost_looks
from ..scene.objects import Pair, scene_rate
from ..scene.riders import gather_riders, moving_riders, riders_of, with_parts
from ..scene.weights import has_trained_weights
from ..settings.training import RELATIVE
from . import tasks
from .reporting import ReportingOperator

WHOLE = "WHOLE"
ABOUT = {
    "crowd": "For many characters, far away: few shapes and proxies, four influences",
    "game": "For real time: some shapes and proxies, four influences",
    "film": "What cannot be told from the whole model",
    "latent": "The model's own bones and shapes, with motion from a solver; takes a while, and meets no colliders",
    "hero": "Carried on by a solver, on bones and shape keys of this shot's own; takes long",
}
QUALITY_ITEMS = [
    (WHOLE, "Whole", "All that the model has"),
    *((name, name.capitalize(), ABOUT.get(name, level.about)) for name, level in QUALITIES.items()),
]
INPUTS, MOTION, SHOT = "bake", "motion.usdc", "shot.usdc"  # folder of a bake's inputs beside the model; files
SHAPED = "shaped.usdc"  # the character with shape keys that change
START = "start.usdc"  # the cloth that a bake goes on from
RIDDEN = "ridden.usdc"  # the character with what rides on the garment
BENEATH = "beneath"  # folder of the garments that it is put over


class TimelineOperator(tasks.OutsideOperator):
    """Base of operators that put a shot on the timeline; `prepare` sets these.

    Attributes:
        pair: the garment and its armature.
        shot: the file to read.
        take: the frames.
        simulated: whether modifiers may simulate the garment until the shot is on the timeline.
        on: the model on the body of its family that the character has; None without a family.
    """

    simulated = False
    on: BodyModel | None = None
    pair: Pair
    shot: Path
    take: SampledTake

    def closing(self) -> Iterator[float]:
        """Read what was baked, before `finish` writes it: each takes time."""
        from ssilk_usd.shots.read import read_baked

        self.joints = self.bakeable_joints()
        self.baked = read_baked(self.shot)
        yield 1.0

    def bakeable_joints(self) -> Joints:
        """Return the joints as they are by now; raise `SetupError` where nothing can be baked onto them any more."""
        garment, armature = self.pair.objects()
        joints = read_joints(armature, garment)
        need_bakeable(garment, armature, joints, simulated=self.simulated)
        need_tracks(animated(garment, armature))
        return joints

    def put_on_timeline(self) -> str:
        """Put keys in place of those baked before; return what was done."""
        garment, armature = self.pair.objects()
        joints, read = self.bakeable_joints(), self.joints
        if joints.names != read.names or not np.array_equal(joints.parents, read.parents):
            raise SetupError(
                f"Bones of '{armature.name}' were changed while '{garment.name}' was baked; bake it again."
            )
        skinned = self.baked.garment
        trained = TrainedJoints(skinned.joint_names, skinned.bind_transforms)
        if self.on:
            joints = known_as(joints, trained, chosen_bones(garment))
        else:
            joints = joints_known_to(garment, armature, joints, trained)
        playing.stop(garment)
        apply_bake(garment, armature, joints, self.baked, self.on.base if self.on else None)
        order = joint_order(joints, self.baked.garment.joint_names, fewer_proxies=True)
        left = int(np.count_nonzero(order < 0))
        still = f" ({left} proxies are not in it and stay at rest)" if left else ""
        overridden = told(garment, armature, joints, self.baked)
        self.level = "WARNING" if overridden else "INFO"
        said = f", {overridden}" if overridden else ""
        return f"frames {self.take.frames[0]} to {self.take.frames[-1]}{still}{told_renames(joints)}{said}"


class BakeGarment(TimelineOperator, bpy.types.Operator):
    """Bake the trained garment over the scene's frames, as bones and shape keys; what was baked before is replaced"""

    bl_idname = "ssilk.bake"
    bl_label = "Bake"
    undo = "Bake"

    to_timeline: BoolProperty(
        name="To Timeline", description="Put keys on the proxies and on shape keys of the garment", default=True
    )
    to_usd: BoolProperty(name="To USD", description="Write a UsdSkel shot, with the body")
    filepath: StringProperty(
        name="USD File", description="Shot to write; named like the garment, beside the blend file, when empty",
        subtype="FILE_PATH", options=RELATIVE,
    )  # fmt: skip
    quality: EnumProperty(name="Quality", items=QUALITY_ITEMS)
    pre_roll: FloatProperty(
        name="Pre-Roll",
        description="How long the garment settles in the first pose before the first frame",
        default=1.0,
        min=0.0,
        max=60.0,
        subtype="TIME_ABSOLUTE",
        unit="TIME_ABSOLUTE",
    )

    go_on: BoolProperty(
        name="Start From Previous Bake",
        description="Begin with the cloth as the bake before this one shows it in the first frame, in place of cloth "
        "at rest; the frames before must have been baked",
    )

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        return tasks.busy() or unplayable_here(context) or unready(context) or no_model(context.object)

    def invoke(self, context: bpy.types.Context, _: bpy.types.Event) -> set[str]:
        """Ask for the options."""
        return context.window_manager.invoke_props_dialog(self)

    def draw(self, _: bpy.types.Context) -> None:
        """Draw the options; a file is asked for only where one is written."""
        self.layout.use_property_split, self.layout.use_property_decorate = True, False
        for name in ("to_timeline", "to_usd", "filepath", "quality", "go_on", "pre_roll"):
            row = self.layout.row()
            row.enabled = (name != "filepath" or self.to_usd) and (name != "pre_roll" or not self.go_on)
            row.prop(self, name)

    def prepare(self, context: bpy.types.Context) -> Work:
        garment = context.object
        if not self.to_timeline and not self.to_usd:
            raise SetupError("Choose where to bake to: the timeline, USD, or both.")
        if garment.ssilk.certify and (missing := no_certificates(context)):
            raise SetupError(f"{missing}, or switch Certify off.")
        self.model, armature = model_of(garment), armature_of(garment)
        solves = self.quality != WHOLE and QUALITIES[self.quality].refine
        if solves and garment.ssilk.hold > 1:
            raise SetupError("A solver moves each frame: set Hold Frames to 1, or choose another quality.")
        if solves and garment.ssilk.loop:
            raise SetupError("A solver does not come back to its start: switch Loop off, or choose another quality.")
        rough = friction_options(garment)
        if rough and not (solves and QUALITIES[self.quality].feedback):
            self.report({"WARNING"}, "Friction is left out: bakes as Hero know it.")
            rough = []
        joints = self.known_joints(garment, armature)
        self.in_fabric += rough
        self.need_start(garment)
        need_bakeable(garment, armature, joints)
        need_tracks(animated(garment, armature))
        if self.to_timeline and (solves or is_held(garment)):
            need_movable(armature, joints.proxies)
        (self.take,) = prepare_takes(armature, [Source(TIMELINE, "Timeline")])
        self.held = HeldBones.of(garment, joints, self.take.frames, self.trained_joints)
        self.scene = None
        if self.on:
            self.scene = self.on.moved(gather(garment, joints=joints))
        elif not (self.model.parent / STAGE).exists():
            self.scene = gather(garment, joints=joints)
        self.keys = SampledKeys.of(garment, self.take.frames)
        followed = followed_bodies(garment)
        tell_changing_shapes(self, garment, followed=followed)
        if followed and (self.quality == WHOLE or not (solves or QUALITIES[self.quality].latent_iterations)):
            names = ", ".join(f"'{body.name}'" for body in followed)
            text = f"The network does not see that shape keys of {names} change; a bake as Hero meets what is seen"
            self.report({"WARNING"}, f"{text}.")
        if not self.meets_colliders and (missed := unseen(garment, armature, "The bake")):
            self.report({"WARNING"}, f"{missed}.")
        self.pair = Pair.of(garment, armature)
        self.shot = usd_path(garment, self.filepath) if self.to_usd else None
        self.riders = gather_riders(garment, self.trained) if self.to_usd else {}
        if self.to_usd:
            self.tell_lost(garment, armature)
        self.python = interpreter(preferences(context))
        self.bones, self.character = joints.bones, joints.character
        self.inputs = inputs_folder(garment, self.model)
        self.words = {f"{self.inputs.name}/{MOTION}": "the timeline"}
        self.meets, self.left_out = False, ""
        self.over = ShownBeneath(garment, self.take.frames) if solves or garment.ssilk.certify else None
        closing = self.closing() if self.to_timeline else None
        return Work(
            f"Baking '{garment.name}'", self.commands, parent=bpy.app.tempdir, steps=self.steps(), closing=closing,
            rephrase=self.rephrase,
        )  # fmt: skip

    def tell_lost(self, garment: bpy.types.Object, armature: bpy.types.Object) -> None:
        """Report what a shot in USD lacks of what Blender shows."""
        written = [garment, *bodies_of(garment, armature), *with_parts(riders_of(garment))]
        if looks := lost_looks(written):
            text = f"{'; '.join(looks)}. Bake to the timeline and use Blender's own export to keep these"
            self.report({"WARNING"}, f"In USD {text}.")
        if parts := left_behind(armature, written):
            self.report({"WARNING"}, f"The shot in USD holds the garment and its bodies alone, without {parts}.")
        if moving := moving_riders(garment):
            text = "what moves them besides the cloth is not in the shot in USD"
            self.report({"WARNING"}, f"{moving}: {text}.")
        if over := overriding(garment, armature):
            text = "The shot in USD holds the network's own motion, without what stands over it in Blender"
            self.report({"WARNING"}, f"{text}: {'; '.join(over)}.")

    def known_joints(self, garment: bpy.types.Object, armature: bpy.types.Object) -> Joints:
        """Return the joints under the names that the model knows; raise `SsilkError` where it cannot be read."""
        try:
            file = load_model(self.model)
        except SsilkError as error:
            raise SetupError(reworded(str(error), self.model.parent, recall(self.model.parent))) from error
        self.on, joints = None, read_joints(armature, garment)
        if file.bodies:
            self.on = on_its_body(file, garment, armature, joints, chosen_bones(garment))
            file = self.on.worn.file
        scene, self.sees = file.scene, file.config.proximity_points > 0
        self.trained, self.model_rate = scene.garment.mesh, file.config.fps
        self.trained_joints = scene.joint_names
        self.in_fabric = played_options(garment) if file.fabrics else []
        self.prim = split_location(scene.garment.mesh.path)[1]
        if self.on:
            return self.on.joints
        trained = TrainedJoints(scene.joint_names, scene.bind_transforms)
        joints = joints_known_to(garment, armature, joints, trained)
        joint_order(joints, scene.joint_names, fewer_proxies=True)
        return joints

    def need_start(self, garment: bpy.types.Object) -> None:
        """Raise `SetupError` where a bake that is to go on from another cannot."""
        if not self.go_on:
            return
        latent = self.quality != WHOLE and QUALITIES[self.quality].latent_iterations
        for reason, there in (
            (f"nothing was baked for '{garment.name}'", not has_keys(garment)),
            ("its model is of a family of bodies", self.on is not None),
            ("Loop is on", garment.ssilk.loop),
            ("a solver in latents starts by itself", latent),
            ("its poses are held (Free, Hold Frames)", is_held(garment)),
        ):
            if there:
                raise SetupError(f"No bake can go on from the previous one: {reason}.")

    def rephrase(self, sentence: str) -> str:
        """Return a sentence with names of objects in place of files that were made for the bake."""
        sentence = reworded(sentence, self.work.folder, {SHOT: f"the bake of '{self.pair.name}'"})
        sentence = reworded(sentence, self.inputs.parent, self.words)
        return with_bones(reworded(sentence, self.model.parent, recall(self.model.parent)), self.bones)

    def steps(self) -> Iterator[float]:
        """Sample the timeline, then write it."""
        _, armature = self.pair.objects()
        yield from sample(armature, self.character, [self.take])
        yield from loading_usd()
        from ssilk_usd.writing.files import write_direction, write_motion

        motion = self.take.motion(self.character)
        met: tuple[Collider, ...] = ()
        if self.meets_colliders:
            read = MetColliders(*self.pair.objects(), self.take.frames)
            yield from read.sample()
            met, self.left_out = read.found, left_out(read)
            self.meets = bool(met)
        yield from self.keys.sample()
        world, skeleton = (
            world_over(bpy.context.scene, self.take.frames, motion.fps, met),
            self.character.skeleton(ROOT),
        )
        if self.held.hand:
            yield from sample(armature, self.held.joints, [self.held.hand])
            motion, skeleton = self.held.with_proxies(motion, skeleton)
        write_motion(self.work.folder / MOTION, motion, skeleton, world)
        if self.go_on:
            yield from self.write_start()
        if self.over:
            yield from self.over.write(self.inputs / BENEATH)
        garment, _ = self.pair.objects()
        free, hold = freedom(garment, self.take.frames), garment.ssilk.hold
        if hold > 1 or (free < 1).any() or self.held.parts:
            parts, groups = self.held.parts, self.held.groups
            write_direction(self.work.folder / MOTION, self.prim, free, self.take.frames.start, hold, parts, groups)
        stage = self.model.parent / STAGE
        garment, _ = self.pair.objects()
        followed = followed_bodies(garment)
        self.reshaped = f" ({self.on.told})" if self.on and self.on.told else ""
        if self.on is None and stage.exists():
            self.reshaped = reshaped(garment, self.character, stage, followed)
        if self.on is None and self.to_usd and stage.exists():
            self.reshaped += corrected(garment, self.character, stage)

    def write_start(self) -> Iterator[float]:
        """Write the cloth that the previous bake shows in the first frame, and a step of the model before."""
        from ssilk_usd.writing.files import write_cache

        first, rate = self.take.frames.start, scene_rate()
        frames = range(first - max(1, math.ceil(rate / self.model_rate)), first + 1)
        points: list[np.ndarray] = []
        yield from sample_vertices(self.pair.objects()[0], frames, points)
        write_cache(self.inputs / START, self.trained, points, rate, frames.start)

    @property
    def meets_colliders(self) -> bool:
        """Whether colliders count at this quality: the network sees them, or the simulator's solver meets them."""
        level = None if self.quality == WHOLE else QUALITIES[self.quality]
        return bool(level and level.refine) or (self.sees and not (level and level.latent_iterations))

    def commands(self, folder: Path) -> list[list[str]]:
        """Write the inputs of the bake; return the command."""
        from ssilk_usd.writing.world import COLLIDERS

        garment, armature = self.pair.objects()
        need_company(garment, armature, self.take)
        inputs = self.inputs
        shutil.copyfile(folder / MOTION, inputs / MOTION)
        stage = self.model.parent / STAGE
        if self.scene:
            given = hand_over(self.scene, self.pair, inputs)
            self.words |= {f"{inputs.name}/{made}": name for made, name in given.words.items()}
            stage = inputs / STAGE
        if self.keys.bodies and self.keys.write(inputs / SHAPED, stage, inputs / MOTION, garment, self.character):
            self.words[f"{inputs.name}/{SHAPED}"] = "the character"
            stage = inputs / SHAPED
        if self.riders:
            from ssilk_usd.writing.riders import write_riders

            write_riders(inputs / RIDDEN, stage, self.prim, self.riders)
            self.words[f"{inputs.name}/{RIDDEN}"] = f"what rides on '{self.pair.name}'"
            stage = inputs / RIDDEN
        self.shot = self.shot or folder / SHOT
        # Which of them are the body's own is known by now.
        collider = ["--collider", COLLIDERS] if self.meets else []
        level = [] if self.quality == WHOLE else ["--quality", self.quality]
        certify = ["--certify"] if garment.ssilk.certify else []
        loop = ["--loop"] if garment.ssilk.loop else ["--pre-roll", f"{self.pre_roll:g}"]  # rounds are its run-up
        if self.go_on:
            self.words[f"{inputs.name}/{START}"] = "the previous bake"
            loop = ["--start-cloth", str(inputs / START)]
        beneath = self.over.files if self.over else {}
        self.words |= {f"{inputs.name}/{BENEATH}/{path.name}": f"'{name}'" for name, path in beneath.items()}
        over = ["--over", *map(str, beneath.values())] if beneath else []
        # A level may have fewer frames.
        rate = ["--fps", repr(scene_rate())] if self.to_timeline or over else []
        return [
            [
                self.python, "-m", "ssilk_core", "bake", str(self.model), "--stage", str(stage),
                "--motion", str(inputs / MOTION), "-o", str(self.shot),
                *loop, *level, *rate, *collider, *certify, *over, *self.in_fabric, "--json",
            ]
        ]  # fmt: skip

    def closing(self) -> Iterator[float]:
        """Read what was baked, and whether classes were changed since the garment was trained."""
        yield from super().closing()
        self.reclassed = reclassed(self.pair.objects()[0], self.model)
        yield 1.0

    def finish(self, context: bpy.types.Context, work: Work) -> str:
        where = [self.put_on_timeline() + self.reclassed] if self.to_timeline else []
        where += [str(self.shot)] if self.to_usd else []
        said = f"{lost(work.result)}{certificate(work.result)}{seam(work.result)}{self.reshaped}{self.left_out}"
        return f"'{self.pair.name}' is baked: {' and '.join(where)}{said}."


class RemoveBake(ReportingOperator, bpy.types.Operator):
    """Remove the keys and shape keys that were baked or played live, and give the garment its own weights back"""

    bl_idname = "ssilk.remove_bake"
    bl_label = "Remove Bake"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        if reason := unplayable_here(context):
            return reason
        worn = not context.object.data.library and has_trained_weights(context.object)
        baked = has_keys(context.object) or worn
        return "" if baked else f"Nothing was baked for '{context.object.name}'"

    def apply(self, context: bpy.types.Context) -> str:
        garment = context.object
        playing.stop(garment)
        remove_bake(garment, armature_of(garment))
        return f"What was baked for '{garment.name}' is gone."


def lost(figures: Mapping[str, Any]) -> str:
    """Return in words how far bones and shape keys are from what they stand for; empty where nothing was fitted."""
    topic = "refined: " if "refined: shapes of the shot" in figures else ""
    count = figures.get(f"{topic}shapes of the shot")
    if count is None:
        return ""
    typical, most = (figures[f"{topic}joints lose, {which} [mm]"] for which in ("RMS", "at most"))
    return (
        f"; bones and {count} shape keys are within {typical:.2g} mm (RMS), {most:.2g} mm at most, "
        "of what was simulated"
    )


def certificate(figures: Mapping[str, Any]) -> str:
    """Return in words how many frames are free of intersections and of skin; empty where that was not asked."""
    return f"; {figures['certificate']}" if "certificate" in figures else ""


def seam(figures: Mapping[str, Any]) -> str:
    """Return in words how the end of a loop meets its beginning; empty where it is none."""
    if "loop: seam, at most [mm]" not in figures:
        return ""
    left, before = figures["loop: seam, at most [mm]"], figures["loop: seam from rest, at most [mm]"]
    end = "last frame" if figures["loop: last frame"].startswith("shows") else "frame after the last"
    return f"; the loop's {end} is within {left:.2g} mm of its first, {before:.3g} mm where it starts at rest"


def reclassed(garment: bpy.types.Object, model: Path) -> str:
    """Return a note if a garment's classes differ from its model's; empty if not, or if either cannot be read."""
    try:
        file, classes = load_model(model), current_classes(garment.data)
    except SsilkError:
        return ""
    if classes is None:
        return ""
    trained = file.scene.classes
    loosened = (
        (trained == TIGHT) & (classes == PINNED) if file.provenance.get("over") else False
    )  # by training itself
    if np.array_equal(trained, np.where(loosened, TIGHT, classes)):
        return ""
    return " (as it was trained: classes were changed since, which take a new rig and a new training)"


def usd_path(garment: bpy.types.Object, chosen: str) -> Path:
    """Return the file of a shot.

    Raises:
        SetupError: nothing was chosen, and the blend file has no place yet.
    """
    if not chosen and not bpy.data.filepath:
        raise SetupError("Save the file first, or choose a USD file.")
    path = Path(bpy.path.abspath(chosen or f"//{bpy.path.clean_name(garment.name)}.usdc"))
    if path.suffix not in LAYER_SUFFIXES:
        raise SetupError(f"'{path.name}' is no name for a shot; it ends in .usdc, .usd or .usda.")
    return path


def inputs_folder(garment: bpy.types.Object, model: Path) -> Path:
    """Return the folder for a bake's inputs, to which the shot's provenance points: beside the model.

    Where a shot links the garment it is beside the shot: other files' folders are not written to.

    Raises:
        SetupError: nothing can be written there, or the shot has no place yet.
    """
    folder, todo = model.parent / INPUTS, "move the model"
    if is_override(garment):
        if not bpy.data.filepath:
            raise SetupError("Save the file first: what a bake of a linked garment reads lies beside it.")
        folder = trainings_folder() / f"{bpy.path.clean_name(garment.name)} {INPUTS}"
        todo = "save the blend file elsewhere"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SetupError(f"{folder} cannot be made ({error.strerror or error}); {todo}.") from error
    if not os.access(folder, os.W_OK):
        raise SetupError(f"Nothing can be written into {folder}; {todo}.")
    return folder


CLASSES = (BakeGarment, RemoveBake)
