# SPDX-License-Identifier: GPL-3.0-or-later
"""Motions for a character that has none."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import bpy

from ssilk_core.scene.assets import Motion

from ..errors import SetupError
from ..motions.demo import add_action, channels_of, hand_over_joints, read_motions
from ..motions.keys import Channel
from ..motions.sources import ACTION, TIMELINE, Source, assign, is_still
from ..outside.work import Work
from ..preferences import interpreter, preferences, unready
from ..scene.armature import leader_of, read_joints
from ..scene.garment import armature_of, unusable_here
from ..scene.objects import Pair
from . import tasks
from .training import add_motion

SCRIPT = Path(__file__).parents[1] / "outside" / "demo_motions.py"
JOINTS, MADE = "joints.npz", "motions.npz"
SHOWN = "walk"  # the motion that the armature plays from then on


class AddDemoMotions(tasks.OutsideOperator, bpy.types.Operator):
    """Give a two-legged character that nothing moves the demo's motions as actions: it walks, runs, jumps, turns"""

    bl_idname = "ssilk.add_demo_motions"
    bl_label = "Add Demo Motions"
    undo = "Add Demo Motions"

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        return tasks.busy() or unusable_here(context) or unready(context)

    def prepare(self, context: bpy.types.Context) -> Work:
        garment = context.object
        armature = leader_of(armature_of(garment))
        if not is_still(armature):
            raise SetupError(f"'{armature.name}' moves already; find its motions.")
        self.pair, self.joints = Pair.of(garment, armature), read_joints(armature, garment).character
        self.moved: list[tuple[Motion, list[Channel]]] = []
        title, python = f"Making motions for '{armature.name}'", interpreter(preferences(context))

        def commands(folder: Path) -> list[list[str]]:
            hand_over_joints(folder / JOINTS, self.joints)
            return [[python, str(SCRIPT), str(folder / JOINTS), str(folder / MADE)]]

        return Work(title, commands, parent=bpy.app.tempdir, closing=self.closing())

    def explain(self, work: Work) -> str:
        name = self.pair.armature[1]
        if not (work.error and work.error == work.text):  # what the motions need was not there
            return work.error
        return (
            f"Nothing moves '{name}', and the demo's motions need a two-legged rig with bones named Hips, LeftUpLeg, "
            "LeftArm and so on; give it an action, or add files of motions."
        )

    def closing(self) -> Iterator[float]:
        """Make the keys of one motion after another."""
        motions = read_motions(self.work.folder / MADE)
        for motion in motions:
            _, armature = self.pair.objects()
            self.moved.append((motion, []))
            for _, channels in channels_of(armature, self.joints, motion):
                self.moved[-1][1].extend(channels)
            yield len(self.moved) / len(motions)

    def finish(self, context: bpy.types.Context, work: Work) -> str:
        garment, armature = self.pair.objects()
        actions = [add_action(armature, motion, channels) for motion, channels in self.moved]
        for name in self.joints.names:
            armature.pose.bones[name].rotation_mode = "QUATERNION"
        shown = actions[[motion.path for motion, _ in self.moved].index(SHOWN)]
        assign(armature.animation_data_create(), shown)
        scene = context.scene
        scene.frame_end = max(scene.frame_end, int(shown.frame_range[1]))  # the import of a still character has one
        for item in garment.ssilk.training.motions:
            item.use = item.use and item.kind != TIMELINE
        for action in actions:
            add_motion(garment, Source(ACTION, action.name))
        return f"'{armature.name}' has {len(actions)} motions; it plays '{shown.name}'."


CLASSES = (AddDemoMotions,)
