# SPDX-License-Identifier: GPL-3.0-or-later
"""Turning a garment's simulation in Blender into bones and shape keys."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np

from ..errors import SetupError
from ..motions.keys import need_tracks
from ..motions.sampling import need_company, prepare_takes, sample
from ..motions.simulated import need_moved, need_simulated, sample_vertices, switch_off
from ..motions.sources import TIMELINE, Source
from ..outside.work import Work
from ..playback.bake import animated, need_bakeable, need_movable
from ..preferences import interpreter, preferences, unready
from ..scene.armature import read_joints
from ..scene.garment import armature_of, unplayable_here
from ..scene.gather import ROOT, gather
from ..scene.handover import STAGE, hand_over, loading_usd
from ..scene.objects import Pair, scene_rate
from . import tasks
from .baking import MOTION, SHOT, TimelineOperator, lost

CACHE = "cache.usdc"


class SimulationToBones(TimelineOperator, bpy.types.Operator):
    """Turn the garment's simulation or cache into keys of its proxies and shape keys, and switch it off"""

    bl_idname = "ssilk.to_bones"
    bl_label = "To Bones"
    undo = "To Bones"
    simulated = True

    @classmethod
    def refusal(cls, context: bpy.types.Context) -> str:
        if reason := tasks.busy() or unplayable_here(context) or unready(context):
            return reason
        try:
            need_simulated(context.object)
        except SetupError as error:
            return str(error).removesuffix(".")
        return ""

    def prepare(self, context: bpy.types.Context) -> Work:
        garment = context.object
        armature = armature_of(garment)
        joints = read_joints(armature, garment)
        if not joints.proxy_count:
            raise SetupError(f"'{garment.name}' has no proxies; generate its rig.")
        need_bakeable(garment, armature, joints, simulated=True)
        need_tracks(animated(garment, armature))
        need_movable(armature, joints.proxies)
        need_simulated(garment)
        (self.take,) = prepare_takes(armature, [Source(TIMELINE, "Timeline")])
        self.scene, self.pair = gather(garment, simulated=True), Pair.of(garment, armature)
        self.points: list[np.ndarray] = []
        self.python, self.character = interpreter(preferences(context)), joints.character
        return Work(
            f"Turning '{garment.name}' into bones", self.commands, parent=bpy.app.tempdir, steps=self.steps(),
            closing=self.closing(),
        )  # fmt: skip

    def steps(self) -> Iterator[float]:
        """Sample the bones and the garment, then write them."""
        garment, armature = self.pair.objects()
        for part in sample(armature, self.character, [self.take]):
            yield part / 2
        for part in sample_vertices(garment, self.take.frames, self.points):
            yield 0.5 + part / 2
        need_moved(self.pair.objects()[0], self.take.frames, self.points)
        yield from loading_usd()
        from ssilk_usd.writing.files import write_cache, write_motion

        folder, mesh = self.work.folder, self.scene.garment.mesh
        write_motion(folder / MOTION, self.take.motion(self.character), self.character.skeleton(ROOT))
        write_cache(folder / CACHE, mesh, self.points, scene_rate(), self.take.frames.start)

    def commands(self, folder: Path) -> list[list[str]]:
        """Write the stage; return the command."""
        garment, armature = self.pair.objects()
        need_company(garment, armature, self.take)
        handover = hand_over(self.scene, self.pair, folder)
        self.shot = folder / SHOT
        return [
            [
                self.python, "-m", "ssilk_core", "skin", str(folder / CACHE), "--stage", str(folder / STAGE),
                "--garment", handover.prim, "--motion", str(folder / MOTION), "-o", str(self.shot), "--no-body",
                "--json",
            ]
        ]  # fmt: skip

    def finish(self, context: bpy.types.Context, work: Work) -> str:
        done = self.put_on_timeline()
        names = ", ".join(f"'{name}'" for name in switch_off(self.pair.objects()[0]))
        return f"'{self.pair.name}' is on bones: {done}{lost(work.result)}; {names} is switched off."


CLASSES = (SimulationToBones,)
