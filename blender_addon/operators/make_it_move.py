# SPDX-License-Identifier: GPL-3.0-or-later
"""From a mesh to a garment that plays, by the operators that artists have: what is there already is left as it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import bpy

from ssilk_core.errors import SsilkError
from ssilk_core.scene.assets import LOOSE

from ..arrays.enough import enough
from ..errors import SetupError
from ..motions.sources import ACTION, STRIP, TIMELINE, Source, frames_of, is_still
from ..outside.jobs import read_state
from ..playback import playing
from ..playback.models import job_of
from ..preferences import handshake, interpreter, preferences
from ..scene.armature import leader_of, proxy_names
from ..scene.classes import current_classes
from ..scene.garment import armature_of, unusable_here
from ..scene.objects import found_again, scene_rate, select_object
from . import tasks
from .reporting import RefusingOperator, ReportingOperator
from .training import choose_preset

LOOK = 0.2  # seconds between two looks at a step that runs


@dataclass
class Course:
    """The steps that one garment still needs.

    Attributes:
        begun: names of the operators that were called.
        before: the folder of the training that it had at first.
        improves: whether its training goes on after the preset, until it is cancelled.
        told: which motions were taken, in words; empty where all were.
    """

    uid: int
    name: str
    before: Path | None
    improves: bool = True
    begun: list[str] = field(default_factory=list)
    told: str = ""

    @property
    def garment(self) -> bpy.types.Object:
        """The garment; raises `SetupError` if it was deleted."""
        return found_again(self.uid, self.name)


course: Course | None = None  # the one that is under way


class MakeItMove(RefusingOperator, bpy.types.Operator):
    """Classify, rig, choose motions, train, and play it live: it gets better until you finish the training"""

    bl_idname = "ssilk.make_it_move"
    bl_label = "Make It Move"  # no undo step of its own: each step has one

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        if reason := tasks.busy() or unusable_here(context):
            return reason
        if under_way():
            return f"'{course.name}' is under way"
        return "" if bpy.data.filepath else "Save the file first; the training lies beside it"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Begin; without a window do all that can be waited for."""
        begin(context.object, improves=True)
        if bpy.app.background and tasks.failed:
            self.report({"ERROR"}, tasks.failed)
            return {"CANCELLED"}
        return {"FINISHED"}


def begin(garment: bpy.types.Object, *, improves: bool = False) -> None:
    """Begin with a garment; without a window do all that can be waited for.

    Args:
        improves: whether a training without a budget goes on until it is cancelled; others would wait for it.
    """
    global course
    tasks.failed = ""
    course = Course(garment.session_uid, garment.name, job_of(garment), improves)
    if not bpy.app.background:
        bpy.app.timers.register(go_on, first_interval=0.0)
        return
    while go_on() is not None:
        pass


class StopCourse(ReportingOperator, bpy.types.Operator):
    """Take no further step; what was done stays, and a training goes on"""

    bl_idname = "ssilk.stop_course"
    bl_label = "Stop Here"

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        return "" if under_way() or (context.object and context.object.ssilk.awaited) else "Nothing is under way"

    def apply(self, context: bpy.types.Context) -> str:
        stop()
        if tasks.current:
            tasks.current.cancel()
        if context.object:
            context.object.ssilk.awaited = False
        return ""


def go_on() -> float | None:
    """Take the next step once the one before has ended; return when to be called again [s], None at the end."""
    if course is None:
        return None
    if tasks.current or bpy.context.mode != "OBJECT":
        return LOOK
    try:
        needed = next((name for name, needs in STEPS.items() if needs(course)), None)
        if needed is None:
            course.garment.ssilk.awaited = True
            playing.play_what_is_awaited()
        elif needed in course.begun:  # it failed, or was cancelled
            needed = None
        else:
            course.begun.append(needed)
            _call(needed, course.garment)
            if needed == FIND:
                course.told = take_enough(course.garment)
    except SsilkError as error:
        needed, tasks.failed = None, str(error)
    if needed is None:
        stop()
        tasks.redraw(bpy.context)
        return None
    return LOOK


def under_way() -> bool:
    """Return whether there are steps to come; none are once another file was opened, with which timers go."""
    return course is not None and (bpy.app.background or bpy.app.timers.is_registered(go_on))


def stop() -> None:
    """Take no further step."""
    global course
    course = None


def line(garment: bpy.types.Object) -> str:
    """Return what a garment that is under way waits for; empty where it is not."""
    if under_way() and course.uid == garment.session_uid:
        if bpy.context.mode != "OBJECT":
            return "Goes on in Object Mode"
        step = f"Step {len(course.begun)} of at most {len(STEPS)}"
        return f"{step}. {course.told}" if course.told else step
    return "Plays as soon as the training has its first model" if garment.ssilk.awaited else ""


def _call(name: str, garment: bpy.types.Object) -> None:
    """Call an operator on a garment as a button does, with an undo step where it has one.

    Raises:
        SetupError: it refuses.
    """
    windows = bpy.context.window_manager.windows
    window = {"window": windows[0]} if windows else {}
    if bpy.context.view_layer.objects.active != garment:  # an override alone would not hold for mode changes
        select_object(garment)
    with bpy.context.temp_override(**window):
        if name == TRAIN:
            _prepare_training(garment)
        operator = getattr(bpy.ops.ssilk, name.removeprefix("ssilk."))
        try:
            operator("EXEC_DEFAULT", True, **({"improves": _improves(garment)} if name == TRAIN else {}))
        except RuntimeError as error:  # Blender's own way to say what the operator reported, or that it refuses
            raise SetupError(str(error).strip().removeprefix("Error: ").split("\n")[0]) from error


def take_enough(garment: bpy.types.Object) -> str:
    """Leave out found motions that a training does not need; return in words what was left, empty if nothing was.

    All of 76 actions would be sampled for minutes, and a training sees no more of them than its steps.
    """
    choose_preset(garment)
    settings, armature = garment.ssilk.training, leader_of(armature_of(garment))
    used = [item for item in settings.motions if item.use and item.kind in (ACTION, STRIP)]
    lengths = [len(frames_of(armature, Source(item.kind, item.name, item.track))) / scene_rate() for item in used]
    most = DRAFTED if settings.preset == "draft" else TAKEN
    chosen = enough([item.name for item in used], lengths, most)
    for index, item in enumerate(used):
        item.use = index in chosen
    if len(chosen) == len(used):
        return ""
    seconds = sum(lengths[index] for index in chosen)
    return f"Trains on {len(chosen)} of {len(used)} motions, {seconds:.0f} s; choose others under Training"


def has_budget(garment: bpy.types.Object) -> bool:
    """Return whether the artist has said how long a garment is trained; without that it goes on and gets better."""
    return bool(garment.ssilk.training.iterations or garment.ssilk.training.minutes)


def _improves(garment: bpy.types.Object) -> bool:
    return bool(course and course.improves) and not has_budget(garment)


def _prepare_training(garment: bpy.types.Object) -> None:
    """Choose what fits the device, unless the artist has chosen; show what this training makes."""
    choose_preset(garment)
    garment.ssilk.model = ""


def _needs_python(_: Course) -> bool:
    return not interpreter(preferences(bpy.context))


def _needs_check(_: Course) -> bool:
    return handshake(preferences(bpy.context)) is None


def _needs_classes(made: Course) -> bool:
    return current_classes(made.garment.data) is None


def _needs_rig(made: Course) -> bool:
    garment = made.garment
    classes = current_classes(garment.data)
    return bool((classes == LOOSE).any() and not proxy_names(armature_of(garment), garment))


def _needs_motions(made: Course) -> bool:
    return not any(item.use for item in made.garment.ssilk.training.motions)


def _needs_demo_motions(made: Course) -> bool:
    chosen = {item.kind for item in made.garment.ssilk.training.motions if item.use}
    return chosen <= {TIMELINE} and is_still(leader_of(armature_of(made.garment)))


def _needs_training(made: Course) -> bool:
    folder = job_of(made.garment)
    state = folder and read_state(folder)
    return folder == made.before and not (state and state.alive)


TRAIN, FIND = "ssilk.train", "ssilk.find_motions"
DRAFTED, TAKEN = 80.0, 240.0  # seconds of motion that a draft, and any other preset, is given of what is found
STEPS: dict[str, Callable[[Course], bool]] = {
    "ssilk.find_python": _needs_python,
    "ssilk.check_python": _needs_check,
    "ssilk.classify": _needs_classes,
    "ssilk.generate_rig": _needs_rig,
    FIND: _needs_motions,
    "ssilk.add_demo_motions": _needs_demo_motions,
    TRAIN: _needs_training,
}

CLASSES = (MakeItMove, StopCourse)
