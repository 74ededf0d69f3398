# SPDX-License-Identifier: GPL-3.0-or-later
"""A baked garment on its character as a glTF binary."""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy.props import StringProperty

from ssilk_core.files import replacing

from ..errors import SetupError
from ..motions.keys import has_keys
from ..motions.simulated import simulating
from ..playback import playing
from ..playback.gltf import MOST_LOST, export_glb, largest_loss, visible
from ..scene.garment import armature_of, unplayable_here
from .reporting import ReportingOperator

SUFFIX = ".glb"


class ExportGltf(ReportingOperator, bpy.types.Operator):
    """Write the character and its baked garment as a glTF binary over the scene's frames, and compare it with them"""

    bl_idname = "ssilk.export_gltf"
    bl_label = "Export glTF"

    filepath: StringProperty(name="File", description="The .glb to write", subtype="FILE_PATH")
    filter_glob: StringProperty(description="Which files are offered", default="*.glb", options={"HIDDEN"})

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        if reason := unplayable_here(context):
            return reason
        if playing.live(context.object):
            return f"'{context.object.name}' is played live; bake it first"
        if not has_keys(context.object):
            return f"Nothing was baked for '{context.object.name}'"
        several = context.scene.frame_end > context.scene.frame_start
        return "" if several else "The scene has one frame, and an animation needs two; set its end to a later one"

    def invoke(self, context: bpy.types.Context, _: bpy.types.Event) -> set[str]:
        """Ask for the file."""
        if not self.filepath:
            self.filepath = str(proposed(context.object))
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def apply(self, context: bpy.types.Context) -> str:
        garment, path = context.object, Path(bpy.path.abspath(self.filepath))
        if path.suffix != SUFFIX:
            raise SetupError(f"'{path.name}' is no name for a glTF binary; it ends in {SUFFIX}.")
        armature = armature_of(garment)
        with visible([garment, armature]), replacing(path) as unverified:
            export_glb(garment, armature, unverified)
            loss, frame = largest_loss(garment, unverified)
            if not loss <= MOST_LOST:
                raise SetupError(
                    f"'{garment.name}' would be {1000 * loss:.3g} mm off what Blender shows in frame {frame}; "
                    f"{_reason(garment)}."
                )
        return f"'{garment.name}' is in {path.name}, at most {1000 * loss:.2g} mm off what Blender shows."


def proposed(garment: bpy.types.Object) -> Path:
    """Return a file for a garment beside the scene's, or a name alone where the scene was never saved."""
    return Path(bpy.data.filepath).parent / f"{bpy.path.clean_name(garment.name)}{SUFFIX}"


def _reason(garment: bpy.types.Object) -> str:
    """Return why what a glTF file shows of a garment may be off, and what to do."""
    if moving := simulating(garment):
        named = ", ".join(f"'{modifier.name}'" for modifier in moving)
        return f"what modifiers do besides its armature is not in a glTF file, so switch off {named}"
    return "no file was written, since bones and shape keys alone do not move it so; bake it again"


CLASSES = (ExportGltf,)
