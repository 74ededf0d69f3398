# SPDX-License-Identifier: GPL-3.0-or-later
"""Automatic classes and proxy rigs, made outside by `ssilk rig`, and the import of stages that it wrote."""

from __future__ import annotations

from pathlib import Path

import bpy
from bpy.props import BoolProperty, IntProperty, StringProperty

from ..errors import SetupError
from ..outside.work import Work
from ..preferences import interpreter, preferences, unready
from ..rigging.adopt import adopt
from ..rigging.apply import apply_classes, apply_rig
from ..rigging.edit_tracking import find_edits
from ..scene import overlay
from ..scene.armature import is_linked, make_follower, need_editable, proxy_names
from ..scene.classes import current_classes
from ..scene.garment import armature_of, not_in_object_mode, unusable_here
from ..scene.gather import gather
from ..scene.handover import Handover, expose_usd, hand_over, loading_usd, rig_command
from ..scene.objects import Pair
from . import tasks
from .reporting import ReportingOperator


class RigOperator(tasks.OutsideOperator):
    """Base of operators that hand the garment to `ssilk rig`."""

    handover: Handover | None = None

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        return tasks.busy() or unusable_here(context) or unready(context)

    def begin(self, context: bpy.types.Context, title: str, *, classes: bool, options: tuple[str, ...]) -> Work:
        """Write the garment without its proxies, and start `ssilk rig`."""
        garment = context.object
        scene = gather(garment, classes=classes, proxies=False)
        pair, python = Pair.of(garment, armature_of(garment)), interpreter(preferences(context))

        def commands(folder: Path) -> list[list[str]]:
            self.handover = hand_over(scene, pair, folder)
            return [rig_command(python, folder, self.handover, options)]

        return Work(title, commands, parent=bpy.app.tempdir, steps=loading_usd(), rephrase=self.rephrase)

    def rephrase(self, sentence: str) -> str:
        """Return a sentence with names of objects in place of files and prims."""
        return self.handover.in_blender_words(sentence) if self.handover else sentence


class Classify(RigOperator, bpy.types.Operator):
    """Find classes by the garment's distance to the body and by where limbs part; replaces what is painted"""

    bl_idname = "ssilk.classify"
    bl_label = "Classify Automatically"
    undo = "Classify Automatically"

    def prepare(self, context: bpy.types.Context) -> Work:
        tightness = f"{context.object.ssilk.tightness:.6g}"
        options = ("--proxies", "1", "--tightness", tightness)
        return self.begin(context, f"Classifying '{context.object.name}'", classes=False, options=options)

    def finish(self, context: bpy.types.Context, work: Work) -> str:
        garment, _ = self.handover.pair.objects()
        found, _ = self.handover.rig(work.folder)
        apply_classes(garment, found.classes, found.levels)
        overlay.show()
        return f"'{garment.name}' is classified; Tightness makes more of it tight, or less."


class GenerateRig(RigOperator, bpy.types.Operator):
    """Make proxy bones for the loose part, if there is one, and weights for the whole garment, from its classes"""

    bl_idname = "ssilk.generate_rig"
    bl_label = "Generate Proxy Rig"
    undo = "Generate Proxy Rig"
    edits = ""

    proxies: IntProperty(name="Proxies", description="Proxy bones on the loose part", default=20, min=1, max=200)
    roots: IntProperty(
        name="Roots per Cluster",
        description="How many proxies of each connected loose part hang from the character's bones directly",
        default=4,
        min=1,
        max=50,
    )
    keep_edits: BoolProperty(
        name="Keep Edits by Hand",
        description="Keep proxies that were moved, reparented or added, leave out those that were deleted, and keep "
        "the weights of repainted vertices",
        default=True,
    )

    def invoke(self, context: bpy.types.Context, _: bpy.types.Event) -> set[str]:
        """Ask for the options."""
        self.edits = edits_line(context.object)
        return context.window_manager.invoke_props_dialog(self)

    def draw(self, _: bpy.types.Context) -> None:
        """Draw the options, with what there is to keep."""
        for name in ("proxies", "roots", "keep_edits"):
            self.layout.prop(self, name)
        self.layout.label(text=self.edits, translate=False)

    def prepare(self, context: bpy.types.Context) -> Work:
        garment = context.object
        armature, classes = armature_of(garment), current_classes(garment.data)
        if not is_linked(armature):
            need_editable(armature)
        if classes is None:
            raise SetupError(f"'{garment.name}' has no classes; classify or paint it first.")
        options = ("--proxies", str(self.proxies), "--roots", str(self.roots))
        return self.begin(context, f"Rigging '{garment.name}'", classes=True, options=options)

    def finish(self, context: bpy.types.Context, work: Work) -> str:
        garment, armature = self.handover.pair.objects()
        found, rig = self.handover.rig(work.folder)
        if is_linked(armature) and rig.proxy_count:
            armature = make_follower(garment, armature)
        joints = self.handover.scene.joints
        edits = apply_rig(garment, armature, joints, found.classes, rig, keep_edits=self.keep_edits)
        if not rig.proxy_count:
            return f"Nothing of '{garment.name}' is loose; it follows '{armature.name}' without proxies."
        kept = f"; kept by hand: {edits.summary}" if edits.summary else ""
        return f"'{armature.name}' has {len(proxy_names(armature, garment))} proxies for '{garment.name}'{kept}."


def edits_line(garment: bpy.types.Object) -> str:
    """Return one line about what was changed by hand on a garment's rig, or why it has none."""
    try:
        armature = armature_of(garment)
    except SetupError as error:
        return str(error)
    if not proxy_names(armature, garment):
        return f"No proxies yet on '{armature.name}'"
    return f"By hand: {find_edits(armature, garment).summary or 'nothing'}"


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


CLASSES = (Classify, GenerateRig, AdoptRig, ImportStage)
