# SPDX-License-Identifier: GPL-3.0-or-later
"""The garments of a character together: their order from inner to outer, and one after the other trained and baked.

Each is worked on by the operators that artists have for one garment. What is trained lies over the garments beneath
it in the order; trainings wait for each other, so that the model of an inner garment is there when its outer one's
begins.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import bpy
from bpy.props import EnumProperty, StringProperty

from ssilk_core.errors import SsilkError

from ..errors import SetupError
from ..playback.models import no_model
from ..scene.garment import armature_of, garments_of, put_in_order, unplayable_here
from ..scene.objects import found_again, select_object
from . import make_it_move, tasks
from .reporting import RefusingOperator, ReportingOperator
from .training import needs_training

LOOK = 0.2  # seconds between two looks at a garment that is worked on


@dataclass
class Round:
    """Garments that one thing is still done with, inner ones first.

    Attributes:
        what: of this it is done, in words, such as "Training".
        do: it, with the active garment.
        left: session uids and names.
        done: names.
    """

    what: str
    do: Callable[[bpy.types.Object], None]
    left: list[tuple[int, str]]
    done: list[str] = field(default_factory=list)


current: Round | None = None


def go_on() -> float | None:
    """Take the next garment once the one before is done; return when to be called again [s], None at the end."""
    global current
    if current is None:
        return None
    if tasks.current or make_it_move.under_way() or bpy.context.mode != "OBJECT":
        return LOOK
    if tasks.failed or not current.left:
        current = None
        tasks.redraw(bpy.context)
        return None
    uid, name = current.left.pop(0)
    try:
        garment = found_again(uid, name)
        select_object(garment)
        current.do(garment)
        current.done.append(name)
    except SsilkError as error:
        tasks.failed = str(error)
    return LOOK


def under_way() -> bool:
    """Return whether there are garments to come; none are once another file was opened, with which timers go."""
    return current is not None and (bpy.app.background or bpy.app.timers.is_registered(go_on))


def stop() -> None:
    """Take no further garment."""
    global current
    current = None


def line() -> str:
    """Return what is done with the garments of an outfit; empty where nothing is."""
    if not under_way():
        return ""
    return f"{current.what}: {len(current.done)} of {len(current.done) + len(current.left)} garments"


def outfit_of(garment: bpy.types.Object) -> list[bpy.types.Object]:
    """Return the garments of a garment's character, inner ones first; it alone where it belongs to no outfit yet."""
    found = garments_of(armature_of(garment))
    return found if garment in found else [garment]


class MoveLayer(ReportingOperator, bpy.types.Operator):
    """Wear this garment further inside or further outside"""

    bl_idname = "ssilk.move_layer"
    bl_label = "Move Layer"
    bl_options = {"REGISTER", "UNDO"}

    garment: StringProperty(name="Garment", description="Name of the object to work on")
    where: EnumProperty(
        name="Where",
        description="Which way it goes in the order",
        items=[("INNER", "Inner", "Nearer to the skin"), ("OUTER", "Outer", "Farther from the skin")],
    )

    def apply(self, context: bpy.types.Context) -> str:
        garment = context.view_layer.objects.get(self.garment)
        if not garment:
            raise SetupError(f"'{self.garment}' is not in this view layer; show its collection.")
        order = outfit_of(garment)
        place = order.index(garment)
        other = place + (1 if self.where == "OUTER" else -1)
        if not 0 <= other < len(order):
            return ""
        order[place], order[other] = order[other], order[place]
        put_in_order(order)
        return ""


class OutfitOperator(RefusingOperator):
    """Base of operators that do one thing with each garment of an outfit; subclasses say with which, and what."""

    what = ""

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        if reason := tasks.busy() or unplayable_here(context):
            return reason
        return f"{line()} still to come" if under_way() else ""

    def chosen(self, garments: Sequence[bpy.types.Object]) -> list[bpy.types.Object]:
        """Return those of an outfit's garments that it is done with; raise `SetupError` where it cannot be."""
        raise NotImplementedError

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Begin; without a window do all of it."""
        global current
        active = context.object
        try:
            garments = self.chosen(outfit_of(active))
        except SsilkError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        tasks.failed = ""
        current = Round(self.what, self.work(), [(each.session_uid, each.name) for each in garments])
        if not bpy.app.background:
            bpy.app.timers.register(go_on, first_interval=0.0)
            return {"FINISHED"}
        while go_on() is not None:
            pass
        if tasks.failed:
            self.report({"ERROR"}, tasks.failed)
            return {"CANCELLED"}
        select_object(active)
        return {"FINISHED"}

    def work(self) -> Callable[[bpy.types.Object], None]:
        """Return what is done with each garment; it outlives the operator, whose properties it may not ask for."""
        raise NotImplementedError


class TrainOutfit(OutfitOperator, bpy.types.Operator):
    """Train the garments of the character that need it, inner ones first, each over those beneath it"""

    bl_idname = "ssilk.train_outfit"
    bl_label = "Train Outfit"  # no undo step of its own: each step has one
    what = "Training"

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        if reason := super().refusal(context):
            return reason
        return "" if bpy.data.filepath else "Save the file first; the training lies beside it"

    def chosen(self, garments: Sequence[bpy.types.Object]) -> list[bpy.types.Object]:
        put_in_order(garments)  # what was shown is what is trained
        needed = [needs_training(garment) for garment in garments]
        # What lies over one that is trained again is trained again, too.
        found = list(garments[needed.index(True) :]) if any(needed) else []
        if not found:
            raise SetupError("All garments of this outfit are trained, each over those beneath it.")
        return found

    def work(self) -> Callable[[bpy.types.Object], None]:
        return make_it_move.begin


class BakeOutfit(OutfitOperator, bpy.types.Operator):
    """Bake all garments of the character over the scene's frames, as bones and shape keys"""

    bl_idname = "ssilk.bake_outfit"
    bl_label = "Bake Outfit"
    what = "Baking"

    def chosen(self, garments: Sequence[bpy.types.Object]) -> list[bpy.types.Object]:
        for garment in garments:
            if missing := no_model(garment):
                raise SetupError(f"{missing}.")
        return list(garments)

    def work(self) -> Callable[[bpy.types.Object], None]:
        return lambda _: _call("bake")


class HideCoveredByOutfit(OutfitOperator, bpy.types.Operator):
    """Hide faces of the body, and of inner garments, that a garment covers in every frame, a last resort"""

    bl_idname = "ssilk.hide_covered_outfit"
    bl_label = "Hide Covered by Outfit"
    what = "Looking for what is covered"

    def chosen(self, garments: Sequence[bpy.types.Object]) -> list[bpy.types.Object]:
        return list(garments)

    def work(self) -> Callable[[bpy.types.Object], None]:
        return lambda _: _call("hide_covered")


class StopOutfit(ReportingOperator, bpy.types.Operator):
    """Take no further garment; what was done stays"""

    bl_idname = "ssilk.stop_outfit"
    bl_label = "Stop Here"

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        return "" if under_way() else "Nothing is under way"

    def apply(self, context: bpy.types.Context) -> str:
        stop()
        make_it_move.stop()
        if tasks.current:
            tasks.current.cancel()
        return ""


def _call(name: str) -> None:
    """Call an operator on the active garment as a button does; raise `SetupError` where it refuses."""
    windows = bpy.context.window_manager.windows
    with bpy.context.temp_override(**({"window": windows[0]} if windows else {})):
        try:
            getattr(bpy.ops.ssilk, name)("EXEC_DEFAULT", True)
        except RuntimeError as error:  # Blender's own way to say what the operator reported, or that it refuses
            raise SetupError(str(error).strip().removeprefix("Error: ").split("\n")[0]) from error


CLASSES = (MoveLayer, TrainOutfit, BakeOutfit, HideCoveredByOutfit, StopOutfit)
