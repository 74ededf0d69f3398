# SPDX-License-Identifier: Apache-2.0
"""Make It Move: from a mesh to a garment that plays, in one go, by operators that artists have as well."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from .conftest import ROOT, activate, add_mesh, tube

BODY = ROOT / "usd" / "ssilk_usd" / "stages" / "demo_body.usdc"


def test_a_character_that_nothing_moves_gets_the_motions_of_the_demo(ready, monkeypatch):
    from blender_addon.operators import demo_motions
    from blender_addon.scene.armature import read_joints
    from blender_addon.scene.motions import sources
    from blender_addon.scene.units import scene_units
    from ssilk_core.kinematics import motion_transforms

    bpy, made = ready, []
    read = demo_motions.read_motions
    monkeypatch.setattr(demo_motions, "read_motions", lambda path: made.append(read(path)) or made[-1])
    bpy.ops.wm.usd_import(filepath=str(BODY))
    armature = next(thing for thing in bpy.data.objects if thing.type == "ARMATURE")
    skirt = add_mesh(bpy, "Skirt", *tube(24, 5, (0.6, 1.0), (0.5, 0.3)))
    activate(bpy, skirt)
    assert bpy.ops.ssilk.add_demo_motions() == {"FINISHED"}
    names = [source.name for source in sources(armature)[1:]]
    assert len(names) == 20 and [item.name for item in skirt.ssilk.training.motions if item.use] == sorted(
        names, key=[item.name for item in skirt.ssilk.training.motions].index
    )
    assert armature.animation_data.action.name == "Demo walk"
    with pytest.raises(RuntimeError, match="moves already"):
        bpy.ops.ssilk.add_demo_motions()
    joints, scene = read_joints(armature, skirt), bpy.context.scene
    (motion,) = [each for each in made[0] if each.path == "walk"]
    wanted = scene_units().transforms_from_core(motion_transforms(motion, joints.parents))
    scene.render.fps = 24  # as it is by default: keys lie between frames
    for index in (0, 50, 100):
        frame = 1 + index * 24 / 30
        scene.frame_set(int(frame), subframe=frame % 1)
        rig = armature.evaluated_get(bpy.context.evaluated_depsgraph_get())
        there = np.array([rig.matrix_world @ rig.pose.bones[name].matrix for name in joints.names])
        np.testing.assert_allclose(there[:, :3, 3], wanted[index][:, :3, 3], atol=1e-4)


def test_what_is_no_biped_is_told_to_bring_its_motions(ready, skirt):
    with pytest.raises(RuntimeError, match="Nothing moves 'Rig', and the demo's motions need a two-legged rig"):
        ready.ops.ssilk.add_demo_motions()
