# SPDX-License-Identifier: GPL-3.0-or-later
"""The preflight: what `ssilk inspect` finds, selected and repaired in Blender."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ssilk_core.events import format_count

from ..arrays.findings import CROSSING, PUSHED, Clip, read_findings
from ..errors import SetupError
from ..motions.sampling import ChosenMotions
from ..motions.shapes import tell_changing_shapes
from ..motions.sources import Source, mixed_motions
from ..outside.wording import reworded
from ..outside.work import Work
from ..preferences import interpreter, preferences, unready
from ..quality.checks import SCALE, body_findings, look_again, scene_findings
from ..quality.repairs import REPAIRS, apply_scale, move_points, repair_mesh
from ..scene.armature import read_joints
from ..scene.garment import armature_of, beneath, unusable
from ..scene.gather import GatheredScene, gather
from ..scene.handover import MOTIONS, REPAIRED, STAGE, hand_over, inspect_command, loading_usd
from ..scene.objects import Pair, select_bones, select_elements
from ..settings.preflight import FindingItem, keep_findings, shown_finding, size_of
from . import tasks
from .reporting import ReportingOperator
from .rig import RigOperator

INNER = "inner-{}"  # folders of garments beneath, among what is handed over
MOVED, LEFT = "moved ", "left "  # begin what `ssilk inspect --fix` says of settled cloth, and of what stays inside


class InspectOperator(RigOperator):
    """Base of operators that hand the garment to `ssilk inspect`, with those beneath it; subclasses give `words`.

    Attributes:
        inner: the garments beneath, at rest.
        doing: what is done with the garment.
        motions: in which its bodies are looked at; the timeline without any.
    """

    doing = ""
    motions: Sequence[Source] = ()
    inner: Sequence[tuple[Pair, GatheredScene]] = ()

    def prepare(self, context: bpy.types.Context) -> Work:
        garment = context.object
        armature = armature_of(garment)
        self.pair, self.scene = Pair.of(garment, armature), gather(garment)
        self.inner = [
            (Pair.of(each, armature), gather(each, classes=False, proxies=False)) for each in beneath(garment)
        ]
        tell_changing_shapes(self, garment, self.motions)
        self.python = interpreter(preferences(context))
        return Work(
            f"{self.doing} '{garment.name}'", self.commands, parent=bpy.app.tempdir, steps=self.steps(),
            rephrase=self.rephrase,
        )  # fmt: skip

    def steps(self) -> Iterator[float]:
        """Prepare what is written."""
        return loading_usd()

    def commands(self, folder: Path) -> list[list[str]]:
        """Write what is inspected; return the command."""
        self.handover = hand_over(self.scene, self.pair, folder)
        over: list[str] = []
        for number, (pair, scene) in enumerate(self.inner):  # as they are at rest, which is where they were trained
            place = folder / INNER.format(number)
            place.mkdir()
            given = hand_over(scene, pair, place)
            over += ["--over", f"{given.stage}:{given.prim}"]
        return [inspect_command(self.python, folder, self.handover, [*over, *self.words(folder)])]

    def rephrase(self, sentence: str) -> str:
        """Return a sentence with names of objects in place of files and prims, those of garments beneath too."""
        for number, (pair, scene) in enumerate(self.inner if self.handover else ()):
            given = f"{INNER.format(number)}/{STAGE}:{scene.garment.mesh.path}"
            sentence = reworded(sentence, self.work.folder, {given: f"'{pair.name}'"})
        return super().rephrase(sentence)

    def words(self, folder: Path) -> list[str]:
        """Return further arguments of `ssilk inspect`."""
        raise NotImplementedError

    def explain(self, work: Work) -> str:
        return "" if "findings" in work.result else super().explain(work)


class Inspect(InspectOperator, bpy.types.Operator):
    """Look for what would spoil the training: on the mesh, its fit, its classes, and the motions that are chosen"""

    bl_idname = "ssilk.inspect"
    bl_label = "Inspect"
    doing = "Inspecting"

    def prepare(self, context: bpy.types.Context) -> Work:
        garment = context.object
        findings = scene_findings(garment)
        keep_findings(context, garment.name, findings)
        for finding in findings:
            raise SetupError(f"'{finding.prim}': {finding.found}; {finding.fix}.")
        self.chosen, self.preset = ChosenMotions.of(garment, armature_of(garment)), garment.ssilk.training.preset
        self.motions = [take.source for take in self.chosen.takes]
        if mixed := mixed_motions(armature_of(garment), self.motions):
            self.report({"WARNING"}, mixed)
        return super().prepare(context)

    def steps(self) -> Iterator[float]:
        _, armature = self.pair.objects()
        yield from self.chosen.writing(armature, self.scene.joints.character, self.work.folder / MOTIONS)

    def words(self, folder: Path) -> list[str]:
        motions = [*(str(folder / MOTIONS / name) for name in self.chosen.names), *map(str, self.chosen.files)]
        return ["--preset", self.preset, *(["--motion", *motions] if motions else [])]

    def in_words(self, documents: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """Return findings that speak of objects, motions and bones, and not of files that were made for them."""

        def told(text: str) -> str:
            return self.rephrase(reworded(text, self.work.folder, self.chosen.words))

        return [{**each, **{part: told(each[part]) for part in ("found", "why", "fix")}} for each in documents]

    def finish(self, context: bpy.types.Context, work: Work) -> str:
        taken = [Clip(take.source.name, take.frames.start) for take in self.chosen.takes]
        clips = dict(zip((str(work.folder / MOTIONS / name) for name in self.chosen.names), taken))
        clips |= {str(path): Clip(path.name) for path in self.chosen.files}
        findings = read_findings(self.in_words(work.result["findings"]), self.handover.name, self.scene.meshes, clips)
        findings = [*body_findings(self.pair.objects()[0]), *findings]
        keep_findings(context, self.handover.name, findings)
        bad = sum(finding.severity != "info" for finding in findings)
        return (
            f"{format_count(bad, 'findings')} on '{self.handover.name}'."
            if bad
            else f"Nothing is wrong with '{self.handover.name}'."
        )


class SelectFinding(ReportingOperator, bpy.types.Operator):
    """Select what the finding is about, or go to the first frame in question"""

    bl_idname = "ssilk.select_finding"
    bl_label = "Select"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        item = shown_finding(context)
        known = item and item.indices and item.elements in {"vertices", "polygons", "joints", "frames"}
        return "" if known else "This finding is about nothing that can be selected"

    def apply(self, context: bpy.types.Context) -> str:
        item = shown_finding(context)
        if item.elements == "frames":
            context.scene.frame_set(item.indices[0])
        elif item.elements == "joints":
            garment = find_target(context.window_manager.ssilk_preflight.garment)
            armature = armature_of(garment)
            names = read_joints(armature, garment).names
            select_bones(armature, [names[joint] for joint in item.indices])
        else:
            select_elements(unchanged(item), item.elements, item.indices)
        return ""


class FixFinding(ReportingOperator, bpy.types.Operator):
    """Repair what was found, where that needs no decision; look again afterwards"""

    bl_idname = "ssilk.fix_finding"
    bl_label = "Fix"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        item = shown_finding(context)
        return "" if item and fixer(item) == cls.bl_idname else "This finding needs your decision"

    def apply(self, context: bpy.types.Context) -> str:
        item = shown_finding(context)
        thing = find_target(item.target) if item.code == SCALE else unchanged(item)
        if context.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        if item.code == SCALE:
            apply_scale(thing)
        else:
            repair_mesh(thing, item.code, item.indices)
        forget(context)
        look_again(context.window_manager.ssilk_preflight)
        return f"'{thing.name}' is repaired; inspect it again."


class PushOut(InspectOperator, bpy.types.Operator):
    """Settle the garment out of the body and off garments beneath, with little change of shape, and all shape keys"""

    bl_idname = "ssilk.push_out"
    bl_label = "Push Out"
    undo = "Push Out of Body"
    doing = "Pushing out"

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        return tasks.busy() or unusable(context.object) or unready(context)

    def prepare(self, context: bpy.types.Context) -> Work:
        """Leave the mode in which *Select* shows what is inside."""
        if context.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        return super().prepare(context)

    def words(self, folder: Path) -> list[str]:
        return ["--fix", str(folder / REPAIRED)]

    def finish(self, context: bpy.types.Context, work: Work) -> str:
        garment, _ = self.handover.pair.objects()
        points = self.handover.repaired_points(work.folder)
        if len(points) != len(garment.data.vertices):
            raise SetupError(
                f"'{garment.name}' has other findings to fix first: vertices would be merged or removed."
            )
        told = work.result["fixed"]["repaired"]
        left = "".join(f"; {said}" for said in told if said.startswith(LEFT))
        if not any(said.startswith(MOVED) for said in told):
            raise SetupError(f"'{garment.name}' stays as it is{left}.")
        moved = 1000 * move_points(garment, points)
        forget(context)
        return (
            f"{np.count_nonzero(moved)} vertices of '{garment.name}' were pushed out, by "
            f"{moved[moved > 0].mean():.1f} mm on average and {moved.max():.1f} mm at most{left}. Show Pushed Out "
            "colours them; inspect it again."
        )


def fixer(item: FindingItem) -> str:
    """Return the operator that repairs a finding; empty where none does."""
    if item.code in (PUSHED, CROSSING):
        return PushOut.bl_idname
    safe = item.fixable or item.code == "body-inside-out"
    return FixFinding.bl_idname if safe and (item.code in REPAIRS or item.code == SCALE) else ""


def find_target(name: str) -> bpy.types.Object:
    """Return an object by name.

    Raises:
        SetupError: it was deleted or renamed.
    """
    thing = bpy.data.objects.get(name)
    if not thing:
        raise SetupError(f"'{name}' was deleted or renamed; inspect the garment again.")
    return thing


def unchanged(item: FindingItem) -> bpy.types.Object:
    """Return the mesh that a finding is about.

    Raises:
        SetupError: it has other vertices by now.
    """
    thing = find_target(item.target)
    if size_of(item.target) != item.size:
        raise SetupError(f"'{thing.name}' has changed since it was inspected; inspect it again.")
    return thing


def forget(context: bpy.types.Context) -> None:
    """Take the shown finding from the list."""
    preflight = context.window_manager.ssilk_preflight
    preflight.findings.remove(preflight.active)
    preflight.active = max(0, preflight.active - 1)


CLASSES = (Inspect, SelectFinding, FixFinding, PushOut)
