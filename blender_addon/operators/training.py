# SPDX-License-Identifier: GPL-3.0-or-later
"""Training a garment: choosing motions, starting, cancelling, resuming."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

import bpy
from bpy.props import BoolProperty, CollectionProperty, EnumProperty, IntProperty, StringProperty

from ssilk_core.errors import SsilkError
from ssilk_core.files import sha256
from ssilk_core.network.checkpoint import load_model
from ssilk_core.scene.assets import LOOSE

from ..arrays.joints import identifiers
from ..errors import SetupError
from ..motions.sampling import ChosenMotions
from ..motions.shapes import tell_changing_shapes
from ..motions.sources import FILE, TIMELINE, Source, mixed_motions, sources
from ..outside import jobs
from ..outside.wording import BONES, remember
from ..outside.work import Work
from ..playback import models, playing
from ..playback.bake import need_bakeable
from ..playback.models import job_of, orphans, progress_of, relative, trainings, trainings_folder
from ..preferences import interpreter, on_processor, preferences, unready
from ..quality.checks import look_again
from ..scene.armature import leader_of
from ..scene.garment import armature_of, beneath, unusable, unusable_here
from ..scene.gather import GatheredScene, gather
from ..scene.handover import MOTIONS, STAGE, hand_over
from ..scene.objects import Pair
from ..settings.fabric import fabric_options
from ..settings.played import RANGED
from . import tasks
from .reporting import ReportingOperator

LOOK = 1.0  # seconds between two looks at trainings
begun: set[Path] = set()  # folders of trainings that this session of Blender began


class MotionOperator(ReportingOperator):
    """Base of operators on the list of motions."""

    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        return unusable(context.object)


class FindMotions(MotionOperator, bpy.types.Operator):
    """List what the armature plays: the timeline, its actions, its NLA strips; what was chosen stays chosen"""

    bl_idname = "ssilk.find_motions"
    bl_label = "Find Motions"

    def apply(self, context: bpy.types.Context) -> str:
        garment = context.object
        armature = leader_of(armature_of(garment))
        found = sources(armature)
        settings = garment.ssilk.training
        motions = settings.motions
        used = {(item.kind, item.name, item.track): item.use for item in motions}
        files = [item.name for item in motions if item.kind == FILE]
        motions.clear()
        for source in (*found, *(Source(FILE, path) for path in files)):
            key = (source.kind, source.name, source.track)
            add_motion(garment, source).use = used.get(key, source.kind != TIMELINE or len(found) == 1)
        settings.active, settings.search = 0, ""
        choose_preset(garment)
        count = len(found) - 1
        return f"'{armature.name}' has {count} motion{'' if count == 1 else 's'} besides the timeline."


class AddMotionFiles(MotionOperator, bpy.types.Operator):
    """Train on animations of this skeleton in USD files, too"""

    bl_idname = "ssilk.add_motion_files"
    bl_label = "Add Motion Files"

    directory: StringProperty(subtype="DIR_PATH", description="Folder of the files")
    files: CollectionProperty(type=bpy.types.OperatorFileListElement, description="The files' names")
    filter_glob: StringProperty(default="*.usd;*.usda;*.usdc", options={"HIDDEN"}, description="What is listed")

    def invoke(self, context: bpy.types.Context, _: bpy.types.Event) -> set[str]:
        """Ask for the files."""
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def apply(self, context: bpy.types.Context) -> str:
        garment = context.object
        listed = {item.name for item in garment.ssilk.training.motions if item.kind == FILE}
        for file in self.files:
            path = relative(Path(self.directory, file.name))
            if not Path(bpy.path.abspath(path)).is_file():
                raise SetupError(f"There is no file {path}; choose a USD file.")
            if path not in listed:
                add_motion(garment, Source(FILE, path))
        return ""


class RemoveMotion(MotionOperator, bpy.types.Operator):
    """Take this motion off the list"""

    bl_idname = "ssilk.remove_motion"
    bl_label = "Remove Motion"

    index: IntProperty(description="Place in the list", min=0)

    def apply(self, context: bpy.types.Context) -> str:
        motions = context.object.ssilk.training.motions
        if self.index >= len(motions):
            raise SetupError(f"There are only {len(motions)} motions.")
        motions.remove(self.index)
        return ""


class ChooseMotions(MotionOperator, bpy.types.Operator):
    """Choose all motions that are listed, or none of them"""

    bl_idname = "ssilk.choose_motions"
    bl_label = "Choose Motions"

    value: EnumProperty(
        name="Choose",
        items=[("ALL", "All", "Train on all that are listed"), ("NONE", "None", "Train on none of them")],
    )

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        if reason := super().refusal(context):
            return reason
        return "" if context.object.ssilk.training.motions else "There are no motions; find some first"

    def apply(self, context: bpy.types.Context) -> str:
        settings = context.object.ssilk.training
        for item, listed in zip(settings.motions, settings.listed()):
            item.use = self.value == "ALL" if listed else item.use
        return ""


class Train(tasks.OutsideOperator, bpy.types.Operator):
    """Train the garment on the chosen motions, outside Blender: it continues when Blender closes"""

    bl_idname = "ssilk.train"
    bl_label = "Train"  # no undo step: a process outside Blender is not undone

    improves: BoolProperty(description="Go on after the preset, until cancelled", options={"HIDDEN", "SKIP_SAVE"})

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        saved = "" if bpy.data.filepath else "Save the file first; the training lies beside it"
        if reason := tasks.busy() or unusable_here(context) or unready(context) or saved:
            return reason
        known = progress_of(context.object)
        if known and known.alive:
            return f"'{context.object.name}' is being trained already; cancel that first"
        return "" if any(item.use for item in context.object.ssilk.training.motions) else no_motion(context.object)

    def prepare(self, context: bpy.types.Context) -> Work:
        garment = context.object
        armature, settings, folder = armature_of(garment), garment.ssilk.training, job_of(garment)
        running = folder and jobs.read_state(folder)
        if running and running.alive:
            raise SetupError(f"'{garment.name}' is being trained already; cancel that first.")
        if not any(item.use for item in settings.motions):
            raise SetupError(f"{no_motion(garment)}.")
        if settings.iterations and settings.minutes:
            raise SetupError(f"'{garment.name}' has a budget in iterations and in minutes; set one of them to zero.")
        choose_preset(garment)
        self.scene = gather(garment)
        need_trainable(garment, armature, self.scene)
        self.chosen = ChosenMotions.of(garment, armature)
        played = [take.source for take in self.chosen.takes]
        tell_changing_shapes(self, garment, played)
        if mixed := mixed_motions(armature, played):
            self.report({"WARNING"}, mixed)
        if chosen := [f"'{each.name}'" for each in beneath(garment) if each.ssilk.model]:
            text = "a training lies over garments that were trained in this file, and not over a chosen model"
            self.report({"WARNING"}, f"{' and '.join(chosen)} beneath '{garment.name}' has a chosen model; {text}.")
        self.pair = Pair.of(garment, armature)
        title, steps = f"Sampling motions for '{garment.name}'", self.steps()
        return Work(title, lambda _: (), parent=bpy.app.tempdir, steps=steps)

    def steps(self) -> Iterator[float]:
        """Sample the motions and write them."""
        _, armature = self.pair.objects()
        yield from self.chosen.writing(armature, self.scene.joints.character, self.work.folder / MOTIONS)

    def finish(self, context: bpy.types.Context, work: Work) -> str:
        (garment, _), name = self.pair.objects(), self.pair.name
        folder = jobs.create(trainings_folder(), identifiers([name])[0])
        inner = {each.name: job_of(each) for each in beneath(garment) if is_coming(each)}
        given = hand_over(self.scene, self.pair, folder)
        remember(folder, {**given.words, **self.chosen.words, jobs.MODEL: f"the model of '{name}'"})
        remember(folder, given.scene.joints.bones, BONES)
        shutil.move(work.folder / MOTIONS, folder / MOTIONS)
        files = [beside(path, folder) for path in self.chosen.files]
        over = [f"{beside(job, folder)}/{jobs.MODEL}" for job in inner.values() if job]
        command = train_command(garment, given.prim, self.chosen.names, files, over)
        jobs.own(folder, garment.name, Path(bpy.data.filepath).name)
        jobs.begin(interpreter(preferences(context)), folder, command, improves=self.improves)
        begun.add(folder)
        models.forget()
        garment.ssilk.training.folder = relative(folder)
        lies = f", over {' and '.join(repr(each) for each in inner)}" if inner else ""
        return f"The training of '{name}'{lies} began; it lies in {folder}."


class JobOperator(ReportingOperator):
    """Base of operators on the garment's training."""

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        if reason := unusable(context.object):
            return reason
        known = progress_of(context.object)
        if known is None or known.state is None:
            return f"'{context.object.name}' is not being trained"
        return cls.refused(context, known.state)

    @classmethod
    def refused(cls, context: bpy.types.Context, state: jobs.JobState) -> str:
        """Return why nothing can be done with a training in this state; empty if something can."""
        raise NotImplementedError


class CancelTraining(JobOperator, bpy.types.Operator):
    """End the training; its best model is kept, and it can go on from where it is"""

    bl_idname = "ssilk.cancel_training"
    bl_label = "Cancel Training"

    @classmethod
    def refused(cls, context: bpy.types.Context, state: jobs.JobState) -> str:
        if state.alive and state.cancelled:
            return f"The training of '{context.object.name}' ends after its current step"
        return "" if state.alive else f"The training of '{context.object.name}' has ended"

    def apply(self, context: bpy.types.Context) -> str:
        jobs.cancel(job_of(context.object))
        models.forget()
        return f"The training of '{context.object.name}' ends after its current step."


class CancelOrphan(ReportingOperator, bpy.types.Operator):
    """End a training whose garment is not in this file any more; its best model is kept"""

    bl_idname = "ssilk.cancel_orphan"
    bl_label = "Cancel Training"

    folder: StringProperty(description="Folder of the training", options={"HIDDEN", "SKIP_SAVE"})

    def apply(self, context: bpy.types.Context) -> str:
        models.look_for_orphans()
        job = next((orphan.job for orphan in orphans() if str(orphan.job.folder) == self.folder), None)
        if job is None:
            raise SetupError("This training has ended, or its garment is back.")
        jobs.cancel(job.folder)
        return f"The training of '{job.garment}' ends after its current step."


class ResumeTraining(JobOperator, bpy.types.Operator):
    """Let the training go on from where it ended"""

    bl_idname = "ssilk.resume_training"
    bl_label = "Resume Training"

    @classmethod
    def refused(cls, context: bpy.types.Context, state: jobs.JobState) -> str:
        if state.alive or state.state == "done":
            return f"The training of '{context.object.name}' {'still runs' if state.alive else 'is complete'}"
        return unready(context)

    def apply(self, context: bpy.types.Context) -> str:
        folder = job_of(context.object)
        jobs.resume(interpreter(preferences(context)), folder)
        begun.add(folder)
        models.forget()
        return f"The training of '{context.object.name}' goes on."


def choose_preset(garment: bpy.types.Object) -> None:
    """Choose what fits the device, unless the artist has chosen: processors take days for what GPUs do in minutes."""
    settings = garment.ssilk.training
    if not settings.is_property_set("preset"):
        settings.preset = "draft" if on_processor(bpy.context) else "preview"


def no_motion(garment: bpy.types.Object) -> str:
    """Return what to do for a garment whose motions are not chosen."""
    return f"No motion is chosen for '{garment.name}'; find motions, or add files of motions"


def add_motion(garment: bpy.types.Object, source: Source) -> bpy.types.PropertyGroup:
    """Put a motion at the end of a garment's list; return it."""
    item = garment.ssilk.training.motions.add()
    item.kind, item.name, item.track = source.kind, source.name, source.track
    return item


def need_trainable(garment: bpy.types.Object, armature: bpy.types.Object, scene: GatheredScene) -> None:
    """Check that a garment is complete, and that Blender will show what is trained.

    Raises:
        SetupError: it is not; the sentence says what is missing.
    """
    classes = scene.garment.classes
    if classes is None:
        raise SetupError(f"'{garment.name}' has no classes; classify or paint it first.")
    if scene.rig is None and (classes == LOOSE).any():
        raise SetupError(f"'{garment.name}' is loose but has no proxies; generate its rig first.")
    need_bakeable(garment, armature, scene.joints)


def is_coming(garment: bpy.types.Object) -> bool:
    """Return whether a garment has a model of its own training, or one that is under way."""
    folder = job_of(garment)
    state = jobs.read_state(folder) if folder else None
    return bool(folder and ((folder / jobs.MODEL).is_file() or (state and state.alive)))


def needs_training(garment: bpy.types.Object) -> bool:
    """Return whether a garment has no model, and none under way, that was trained over those beneath it.

    A model that the artist has chosen is left as it is.
    """
    if garment.ssilk.model:
        return False
    folder = job_of(garment)
    state = jobs.read_state(folder) if folder else None
    if not folder or not is_coming(garment):
        return True
    inner = [job_of(each) for each in beneath(garment)]
    if state and state.alive:  # it began with what was there, or was coming
        return jobs.models_beneath(folder) != [job / jobs.MODEL for job in inner if job]
    try:
        over = sorted((load_model(folder / jobs.MODEL).provenance.get("over") or {}).values())
    except SsilkError:
        return True
    reached = [sha256(job / jobs.MODEL) for job in inner if job and (job / jobs.MODEL).is_file()]
    return jobs.models_beneath(folder) != [job / jobs.MODEL for job in inner if job] or not set(over) <= set(reached)


def train_command(
    garment: bpy.types.Object, prim: str, takes: Sequence[str], files: Sequence[str], over: Sequence[str] = ()
) -> list[str]:
    """Return the arguments of the Python that has ssilk, for its folder of the job.

    Args:
        over: models of the garments beneath.
    """
    settings = garment.ssilk.training
    motions = [*(f"{MOTIONS}/{name}" for name in takes), *files]
    budget = ["--set", f"iterations={settings.iterations}"] if settings.iterations else []
    budget += ["--minutes", f"{settings.minutes:g}"] if settings.minutes else []
    beneath_it = [word for model in over for word in ("--over", model)]
    fabrics = ["--fabrics", "4", *RANGED] if settings.fabrics else []
    return [
        "-m", "ssilk_core", "train", STAGE, "--garment", prim, "--motions", *motions, "-o", jobs.MODEL,
        *beneath_it, "--preset", settings.preset, *budget, *fabric_options(garment.ssilk.fabric), *fabrics, "--json",
    ]  # fmt: skip


def beside(path: Path, folder: Path) -> str:
    """Return a path as seen from a folder, so that both may be moved together; as it is from another drive."""
    try:
        return os.path.relpath(path, folder)
    except ValueError:
        return str(path)


def watch() -> float:
    """Redraw panels when a training has progressed, and play its new model; return when to be called again [s]."""
    known = trainings()
    fresh = [models.look_for_orphans(known), models.read_all(known)]  # both are asked, so that none is drawn twice
    if any(fresh):
        tasks.redraw(bpy.context)
    preflight = bpy.context.window_manager.ssilk_preflight
    if bpy.context.mode == "OBJECT" and look_again(preflight):
        tasks.redraw(bpy.context)
    if bpy.context.mode == "PAINT_VERTEX":  # a stroke does not draw the panel that counts what is painted
        tasks.redraw(bpy.context)
    playing.take_up_models()
    playing.play_what_is_awaited()
    return LOOK


def start_watching() -> None:
    """Start polling trainings, whatever file is open."""
    bpy.app.timers.register(watch, first_interval=LOOK, persistent=True)


def stop_watching(context: bpy.types.Context) -> None:
    """Stop polling; end the trainings of this session if the preferences ask for it."""
    if bpy.app.timers.is_registered(watch):
        bpy.app.timers.unregister(watch)
    if preferences(context).stop_trainings:
        for folder in begun:
            if folder.exists():
                jobs.cancel(folder)
    begun.clear()


CLASSES = (
    FindMotions, AddMotionFiles, RemoveMotion, ChooseMotions, Train, CancelTraining, CancelOrphan, ResumeTraining,
)  # fmt: skip
