# SPDX-License-Identifier: GPL-3.0-or-later
"""Hiding the skin that a garment covers in every frame, and showing it again."""

from __future__ import annotations

from collections.abc import Iterator

import bpy

from ..outside.work import Work
from ..scene.covered_skin import CoveredSkinSearch
from ..scene.garment import unusable_here
from ..scene.masks import masked, show, unmasked
from ..scene.objects import found_again
from .quality_view import MeasuringOperator, QualityOperator


class HideCoveredSkin(MeasuringOperator, bpy.types.Operator):
    """Hide faces of the body that the garment covers in every frame, a last resort where skin shows"""

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
        hidden, total = self.search.hide(found_again(self.garment, self.called))
        if not hidden:
            return f"'{self.called}' covers no face of the body in every frame; nothing is hidden."
        return f"{hidden} of {total} faces of the body are hidden under '{self.called}'."


class ShowCoveredSkin(QualityOperator, bpy.types.Operator):
    """Show the skin under the garment again"""

    bl_idname = "ssilk.show_covered"
    bl_label = "Show Covered Skin"

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        if reason := unusable_here(context):
            return reason
        return "" if masked(context.object) else f"No skin is hidden under '{context.object.name}'"

    def apply(self, context: bpy.types.Context) -> str:
        show(context.object)
        return f"All skin under '{context.object.name}' is shown."


CLASSES = (HideCoveredSkin, ShowCoveredSkin)
