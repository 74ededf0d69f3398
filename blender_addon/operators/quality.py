# SPDX-License-Identifier: GPL-3.0-or-later
"""Judging a garment: heat maps, worst frames, linear blend skinning (LBS) beside it, and skin that is hidden."""

from __future__ import annotations

from collections.abc import Iterator

import bpy
import numpy as np
from bpy.props import EnumProperty, FloatProperty, IntProperty

from ..arrays.heat import worst_frames
from ..outside.work import Work
from ..playback.models import no_model
from ..quality import heat, lbs_copy
from ..quality.covered_skin import CoveredSkinSearch
from ..scene import overlay
from ..scene.garment import unplayable_here
from ..scene.masks import masked, show, unmasked
from ..scene.objects import found_again
from . import tasks
from .reporting import ReportingOperator

KINDS = [
    (heat.PENETRATION, "Penetration", "How deep vertices lie inside the body"),
    (heat.SKIN, "Skin", "Where covered skin shows through the cloth; on the body, by the depth of the cloth beneath"),
    (heat.STRETCH, "Stretch", "How much longer the cloth is than at rest"),
    (heat.INTERSECTIONS, "Intersections", "Where the cloth passes through itself or through other garments"),
]
PUSHED_OUT = (heat.PUSHED_OUT, "Pushed Out", "How far Push Out moved the rest shape")
MARKER = "SSILK "  # begins the names of markers
APART = 0.5  # seconds between two of the worst frames


class QualityOperator(ReportingOperator):
    """Base of operators on how a garment looks, in object mode."""

    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        return unplayable_here(context)


class MeasuringOperator(tasks.OutsideOperator):
    """Base of operators that measure the garment a little at a time, in object mode."""

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        return tasks.busy() or unplayable_here(context)

    def prepare(self, context: bpy.types.Context) -> Work:
        self.garment, self.called = context.object.session_uid, context.object.name
        return Work(f"Looking at '{self.called}'", lambda _: (), parent=bpy.app.tempdir, steps=self.steps(context))

    def steps(self, context: bpy.types.Context) -> Iterator[float]:
        """Measure, yielding the part that is done."""
        raise NotImplementedError


class ShowHeat(MeasuringOperator, bpy.types.Operator):
    """Colour the garment by penetration, stretch, intersections or Push Out, the body by skin; in Solid shading"""

    bl_idname = "ssilk.show_heat"
    bl_label = "Show Heat"
    undo = "Show Heat"

    kind: EnumProperty(name="Show", items=[*KINDS, PUSHED_OUT])
    deepest: FloatProperty(
        name="Red Depth", description="Depth that is red", default=0.01, min=1e-4, subtype="DISTANCE", unit="LENGTH"
    )
    longest: FloatProperty(
        name="Red Stretch",
        description="Elongation that is red",
        default=0.2,
        min=1e-3,
        soft_max=1.0,
        subtype="FACTOR",
    )

    def steps(self, context: bpy.types.Context) -> Iterator[float]:
        self.frame = context.scene.frame_current
        self.measured = yield from heat.measuring(
            found_again(self.garment, self.called), self.kind, context.evaluated_depsgraph_get()
        )

    def finish(self, context: bpy.types.Context, work: Work) -> str:
        meters = context.scene.unit_settings.scale_length
        red = {heat.STRETCH: self.longest, heat.INTERSECTIONS: 1.0}.get(self.kind, self.deepest * meters)
        heat.show(found_again(self.garment, self.called), self.measured, red)
        overlay.hide()  # classes would tint the heat
        if context.space_data and context.space_data.type == "VIEW_3D":
            context.space_data.shading.color_type = "VERTEX"
        return f"'{self.called}', frame {self.frame}: {self.measured.summary()}."


class HideHeat(QualityOperator, bpy.types.Operator):
    """Remove the colours of the heat map"""

    bl_idname = "ssilk.hide_heat"
    bl_label = "Hide Heat"

    def apply(self, context: bpy.types.Context) -> str:
        heat.hide(context.object)
        view = context.space_data
        if view and view.type == "VIEW_3D" and view.shading.color_type == "VERTEX":
            view.shading.color_type = "MATERIAL"  # other attributes, classes say, would be shown in place of the heat
        return ""


class FindWorst(MeasuringOperator, bpy.types.Operator):
    """Go through the scene's frames and mark those in which most is wrong of the kind that the button shows"""

    bl_idname = "ssilk.find_worst"
    bl_label = "Mark Worst Frames"
    undo = "Mark Worst Frames"

    kind: EnumProperty(name="Look For", items=KINDS)
    count: IntProperty(name="Markers", description="How many frames are marked at most", default=3, min=1, max=50)

    def steps(self, context: bpy.types.Context) -> Iterator[float]:
        scene = context.scene
        before, frames = scene.frame_current, range(scene.frame_start, scene.frame_end + 1)
        self.found = []
        try:
            for frame in frames:
                scene.frame_set(frame)
                garment = found_again(self.garment, self.called)
                steps = heat.measuring(garment, self.kind, context.evaluated_depsgraph_get())
                done = len(self.found) / len(frames)
                self.found.append((yield from heat.scaled(steps, done, 1 / len(frames))))
                yield len(self.found) / len(frames)
        finally:
            scene.frame_set(before)

    def finish(self, context: bpy.types.Context, work: Work) -> str:
        scene, values = context.scene, np.array([each.badness for each in self.found])
        fps = scene.render.fps / scene.render.fps_base
        worst = worst_frames(values, self.count, max(1, round(APART * fps)))
        clear_markers(scene)
        for index in worst:
            scene.timeline_markers.new(f"{MARKER}{self.found[index].summary()}", frame=scene.frame_start + index)
        if not worst:
            return f"'{self.called}' is fine in every frame."
        first = worst[0]
        return f"'{self.called}' is worst in frame {scene.frame_start + first}: {self.found[first].summary()}."


class ClearWorst(ReportingOperator, bpy.types.Operator):
    """Remove the markers of worst frames"""

    bl_idname = "ssilk.clear_worst"
    bl_label = "Clear Marks"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        return "" if own_markers(context.scene) else "No frames are marked"

    def apply(self, context: bpy.types.Context) -> str:
        return f"{clear_markers(context.scene)} markers removed."


class ToggleLbsCopy(QualityOperator, bpy.types.Operator):
    """Show beside the garment how linear blend skinning alone would move it, or remove that"""

    bl_idname = "ssilk.toggle_lbs"
    bl_label = "Linear Blend Skinning Beside"

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        if reason := super().refusal(context):
            return reason
        return "" if lbs_copy.find_copy(context.object) else no_model(context.object)

    def apply(self, context: bpy.types.Context) -> str:
        garment = context.object
        shown = lbs_copy.find_copy(garment)
        if shown:
            lbs_copy.remove_copy(shown)
        else:
            lbs_copy.show_copy(garment)
        return ""


def own_markers(scene: bpy.types.Scene) -> list[bpy.types.TimelineMarker]:
    """Return the markers that were set here."""
    return [marker for marker in scene.timeline_markers if marker.name.startswith(MARKER)]


def clear_markers(scene: bpy.types.Scene) -> int:
    """Remove the markers that were set here; return how many."""
    own = own_markers(scene)
    for marker in own:
        scene.timeline_markers.remove(marker)
    return len(own)


_keys: list[tuple[bpy.types.KeyMap, bpy.types.KeyMapItem]] = []


def add_key() -> None:
    """Let Ctrl Alt P toggle linear blend skinning in 3D views; without windows there are no keys."""
    configuration = bpy.context.window_manager.keyconfigs.addon
    if configuration:
        keymap = configuration.keymaps.new(name="3D View", space_type="VIEW_3D")
        _keys.append((keymap, keymap.keymap_items.new(ToggleLbsCopy.bl_idname, "P", "PRESS", ctrl=True, alt=True)))


def remove_key() -> None:
    """Take the key back."""
    while _keys:
        keymap, item = _keys.pop()
        keymap.keymap_items.remove(item)


class HideCoveredSkin(MeasuringOperator, bpy.types.Operator):
    """Hide faces of the body, and of garments beneath, that the garment covers in every frame, a last resort"""

    bl_idname = "ssilk.hide_covered"
    bl_label = "Hide Covered Skin"
    undo = "Hide Covered Skin"

    def steps(self, context: bpy.types.Context) -> Iterator[float]:
        """Look at the bind pose, then at every frame."""
        scene = context.scene
        before, frames = scene.frame_current, range(scene.frame_start, scene.frame_end + 1)
        self.search = CoveredSkinSearch(found_again(self.garment, self.called))
        yield 0.0
        with unmasked():
            try:
                for done, frame in enumerate(frames, start=1):
                    scene.frame_set(frame)
                    garment = found_again(self.garment, self.called)
                    self.search.add(garment, context.evaluated_depsgraph_get())
                    yield done / len(frames)
            finally:
                scene.frame_set(before)

    def finish(self, context: bpy.types.Context, work: Work) -> str:
        hidden, total, cloth = self.search.hide(found_again(self.garment, self.called))
        inner = f", and {cloth} of garments beneath" if cloth else ""
        if not hidden and not cloth:
            return f"'{self.called}' covers no face of the body in every frame; nothing is hidden."
        return f"{hidden} of {total} faces of the body{inner} are hidden under '{self.called}'."


class ShowCoveredSkin(QualityOperator, bpy.types.Operator):
    """Show the skin under the garment again, and cloth beneath it"""

    bl_idname = "ssilk.show_covered"
    bl_label = "Show Covered Skin"

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        if reason := unplayable_here(context):
            return reason
        return "" if masked(context.object) else f"No skin is hidden under '{context.object.name}'"

    def apply(self, context: bpy.types.Context) -> str:
        show(context.object)
        return f"All skin under '{context.object.name}' is shown."


CLASSES = (ShowHeat, HideHeat, FindWorst, ClearWorst, ToggleLbsCopy, HideCoveredSkin, ShowCoveredSkin)
