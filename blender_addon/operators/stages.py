# SPDX-License-Identifier: GPL-3.0-or-later
"""Stages that `ssilk rig` wrote, imported with their proxies."""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy.props import StringProperty

from ..errors import SetupError
from ..scene.adopt import adopt
from ..scene.garment import not_in_object_mode
from ..scene.handover import expose_usd
from .reporting import ReportingOperator


class StageOperator(ReportingOperator):
    """Base of operators on a stage that an artist chooses."""

    bl_options = {"REGISTER", "UNDO"}

    filepath: StringProperty(name="File", description="USD file that ssilk wrote", subtype="FILE_PATH")
    filter_glob: StringProperty(
        description="Which files are offered", default="*.usd;*.usdc;*.usda;*.usdz", options={"HIDDEN"}
    )

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        return not_in_object_mode(context)

    def invoke(self, context: bpy.types.Context, _: bpy.types.Event) -> set[str]:
        """Ask for the file."""
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def adopted(self) -> tuple[str, float | None]:
        """Mark the proxies of all garments in the file; return what to tell, and its frames per second."""
        path = Path(bpy.path.abspath(self.filepath))
        if not path.is_file():
            raise SetupError(f"There is no file '{path}'; choose a stage that `ssilk rig` wrote.")
        expose_usd()
        from ssilk_usd.reading.facts import playback_rate
        from ssilk_usd.reading.scene import read_rigged

        rigged = read_rigged(path)
        if not rigged:
            raise SetupError(f"No mesh of '{path.name}' has proxies; rig a garment, here or with `ssilk rig`.")
        names = ", ".join(f"{rig.proxy_count} proxies of '{adopt(*of, rig).name}'" for *of, rig in rigged)
        return f"{names} were recognised.", playback_rate(path)


class AdoptRig(StageOperator, bpy.types.Operator):
    """Recognise the proxies of garments that were imported from a stage of `ssilk rig`"""

    bl_idname = "ssilk.adopt_rig"
    bl_label = "Adopt Rig"

    def apply(self, context: bpy.types.Context) -> str:
        return self.adopted()[0]


class ImportStage(StageOperator, bpy.types.Operator):
    """Import a dressed character that `ssilk rig` wrote, with its proxies and its frame rate"""

    bl_idname = "ssilk.import_stage"
    bl_label = "Import Rigged Stage"

    def apply(self, context: bpy.types.Context) -> str:
        path = bpy.path.abspath(self.filepath)
        if not Path(path).is_file():
            raise SetupError(f"There is no file '{path}'; choose a stage that `ssilk rig` wrote.")
        if not hasattr(bpy.ops.wm, "usd_import"):
            raise SetupError("This Blender was built without USD; take one from blender.org.")
        bpy.ops.wm.usd_import(filepath=path)
        told, rate = self.adopted()
        if rate:
            context.scene.render.fps, context.scene.render.fps_base = round(rate), round(rate) / rate
        return told


CLASSES = (AdoptRig, ImportStage)
