# SPDX-License-Identifier: GPL-3.0-or-later
"""A baked garment on its character as a glTF binary, exported beside the artist's Blender."""

from __future__ import annotations

import importlib.util
import shutil
import sys
from pathlib import Path

import bpy
from bpy.props import StringProperty

from ssilk_core.files import replacing

from ..errors import SetupError
from ..motions.keys import has_keys
from ..motions.simulated import simulating
from ..outside import scripts
from ..outside.work import Work
from ..playback import playing
from ..playback.gltf import MOST_LOST, write_seen
from ..scene.garment import armature_of, unplayable_here
from ..scene.objects import Pair
from . import tasks

SUFFIX = ".glb"
SCRIPT = Path(__file__).parents[1] / "outside" / "gltf_export.py"
COPY, MADE, SEEN = "scene.blend", "made.glb", "seen.npy"


class ExportGltf(tasks.OutsideOperator, bpy.types.Operator):
    """Write the character and its baked garment as a glTF binary over the scene's frames, and compare it with them"""

    bl_idname = "ssilk.export_gltf"
    bl_label = "Export glTF"

    filepath: StringProperty(name="File", description="The .glb to write", subtype="FILE_PATH")
    filter_glob: StringProperty(description="Which files are offered", default="*.glb", options={"HIDDEN"})

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        if reason := tasks.busy() or unplayable_here(context):
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

    def prepare(self, context: bpy.types.Context) -> Work:
        garment, self.path = context.object, Path(bpy.path.abspath(self.filepath))
        if self.path.suffix != SUFFIX:
            raise SetupError(f"'{self.path.name}' is no name for a glTF binary; it ends in {SUFFIX}.")
        self.pair = Pair.of(garment, armature_of(garment))
        self.reason = _reason(garment)
        return Work(f"Exporting '{garment.name}'", self.commands, parent=bpy.app.tempdir)

    def commands(self, folder: Path) -> list[list[str]]:
        """Write a copy of the file as it is now, and some of what Blender shows of it; return the command."""
        garment, armature = self.pair.objects()
        write_seen(garment, armature, folder / SEEN)
        trust = "trusted" if scripts.run_here() else "untrusted"
        bpy.ops.wm.save_as_mainfile(filepath=str(folder / COPY), copy=True)
        files = [str(folder / COPY), trust, garment.name, armature.name, str(folder / MADE), str(folder / SEEN)]
        return [[*_blender(), "--", *files, *_folders()]]

    def finish(self, context: bpy.types.Context, work: Work) -> str:
        loss, frame = work.result["loss"], work.result["frame"]
        if not loss <= MOST_LOST:
            raise SetupError(
                f"'{self.pair.name}' would be {1000 * loss:.3g} mm off what Blender shows in frame {frame}; "
                f"{self.reason}."
            )
        apart, where = work.result["apart"], work.result["where"]
        if not apart <= MOST_LOST:
            raise SetupError(
                f"'{self.pair.name}' is {1000 * apart:.3g} mm elsewhere in the Blender that exports it (frame "
                f"{where}), which has no add-ons and only the file's own scripts; bake to keys what Python drivers "
                "and handlers move, and export again."
            )
        with replacing(self.path) as unverified:
            shutil.copyfile(work.folder / MADE, unverified)
        return f"'{self.pair.name}' is in {self.path.name}, at most {1000 * loss:.2g} mm off what Blender shows."


def _blender() -> list[str]:
    """Return what runs a script in a Blender of its own: this program, or this Python where Blender is a module."""
    if not bpy.app.binary_path:
        return [sys.executable, str(SCRIPT)]
    options = ["--background", "--factory-startup", "--python-exit-code", "1"]
    return [bpy.app.binary_path, *options, "--python", str(SCRIPT)]


def _folders() -> list[str]:
    """Return the folders of the modules that this Blender has of ssilk."""
    found = [importlib.util.find_spec(name) for name in ("ssilk_core", "ssilk_usd")]
    return list(dict.fromkeys(str(Path(spec.origin).parents[1]) for spec in found if spec and spec.origin))


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
