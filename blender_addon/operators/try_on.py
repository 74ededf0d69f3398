# SPDX-License-Identifier: GPL-3.0-or-later
"""Trying a garment on other bodies of its character's family, before any training."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
from bpy.props import IntProperty

from ..arrays.try_on import KNOTS
from ..errors import SetupError
from ..outside.work import Work
from ..preferences import interpreter, preferences
from ..quality import tried_on
from ..scene.garment import armature_of, unusable, unusable_here
from ..scene.gather import gather
from ..scene.handover import hand_over, loading_usd
from ..scene.objects import Pair
from ..scene.other_bodies import points_of_stage, points_with_keys
from ..settings.try_on import KEYS
from .reporting import RefusingOperator, ReportingOperator
from .rig import RigOperator

SCRIPT = Path(__file__).parents[1] / "outside" / "try_on.py"
BODIES, CARRIED = "bodies.npz", "carried.npz"


class TryOn(RigOperator, bpy.types.Operator):
    """Show a copy of the garment on another body, beside the character; the garment itself stays as it is"""

    bl_idname = "ssilk.try_on"
    bl_label = "Try On"
    undo = "Try On"

    def prepare(self, context: bpy.types.Context) -> Work:
        garment, settings = context.object, context.object.ssilk.try_on
        armature, python = armature_of(garment), interpreter(preferences(context))
        self.gathered, pair, path = gather(garment), Pair.of(garment, armature), settings.stage
        self.mark, self.ends = tried_on.mark_of(garment), list[np.ndarray]()
        self.body = f"'{Path(path).name}'"
        if settings.body == KEYS:
            chosen = [item for item in settings.keys if item.key]
            values = {item.key: item.value for item in chosen}
            if len(values) < len(chosen):
                raise SetupError("A shape key is chosen twice; remove one.")
            self.ends = points_with_keys(garment, self.gathered, values)
            self.body = ", ".join(f"'{name}' {value:g}" for name, value in values.items())

        def commands(folder: Path) -> list[list[str]]:
            self.ends = self.ends or points_of_stage(self.gathered, path)
            self.handover = hand_over(self.gathered, pair, folder)
            _write_bodies(folder / BODIES, self)
            words = [self.handover.stage, self.handover.prim, folder / BODIES, folder / CARRIED]
            return [[python, str(SCRIPT), *map(str, words)]]

        title = f"Trying on '{garment.name}'"
        return Work(title, commands, parent=bpy.app.tempdir, steps=loading_usd(), rephrase=self.rephrase)

    def finish(self, context: bpy.types.Context, work: Work) -> str:
        garment, _ = self.handover.pair.objects()
        with np.load(work.folder / CARRIED) as made:
            cloth, proxies = made["cloth"], made["proxies"]
        tried = tried_on.TriedOn(self.body, self.mark, cloth, self.ends, proxies)
        garment.ssilk.try_on.share = 1.0
        tried_on.show(garment, self.gathered, tried)
        moved = 1000 * np.linalg.norm(cloth[KNOTS.index(1.0)] - self.gathered.garment.mesh.points, axis=1)
        left = self.rephrase(work.result["left"])
        self.level = "WARNING" if left else "INFO"
        told = "; ".join(filter(None, [*work.result["told"], left]))
        return (
            f"'{garment.name}' is tried on {self.body}, moved by {moved.mean():.0f} mm on average and "
            f"{moved.max():.0f} mm at most{told and '; '}{told}."
        )


def _write_bodies(path: Path, operator: TryOn) -> None:
    """Write where each body mesh has its points at each of the shares, and which of these is told of."""
    points = {
        f"points.{body.mesh.path.rpartition('/')[2]}": np.stack(
            [body.mesh.points + share * (end - body.mesh.points) for share in KNOTS]
        )
        for body, end in zip(operator.gathered.character.bodies, operator.ends)
    }
    np.savez(path, told=KNOTS.index(1.0), **points)


class StopTryingOn(ReportingOperator, bpy.types.Operator):
    """Remove what shows the garment on another body"""

    bl_idname = "ssilk.stop_trying_on"
    bl_label = "Stop Trying On"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        if reason := unusable_here(context):
            return reason
        return "" if tried_on.find(context.object) else f"'{context.object.name}' is not tried on"

    def apply(self, context: bpy.types.Context) -> str:
        tried_on.stop(tried_on.find(context.object))
        return ""


class BodyKeyOperator(RefusingOperator):
    """Base of operators on the list of shape keys that make a body."""

    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        return unusable(context.object)


class AddBodyKey(BodyKeyOperator, bpy.types.Operator):
    """Add a shape key that makes the body to try on"""

    bl_idname = "ssilk.add_body_key"
    bl_label = "Add Shape Key"

    def execute(self, context: bpy.types.Context) -> set[str]:
        context.object.ssilk.try_on.keys.add()
        return {"FINISHED"}


class RemoveBodyKey(BodyKeyOperator, bpy.types.Operator):
    """Take this shape key from the list; the body keeps it"""

    bl_idname = "ssilk.remove_body_key"
    bl_label = "Remove Shape Key"

    index: IntProperty(name="Index", description="Place in the list", options={"HIDDEN"})

    def execute(self, context: bpy.types.Context) -> set[str]:
        context.object.ssilk.try_on.keys.remove(self.index)
        return {"FINISHED"}


CLASSES = (TryOn, StopTryingOn, AddBodyKey, RemoveBodyKey)
