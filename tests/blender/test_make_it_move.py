# SPDX-License-Identifier: Apache-2.0
"""Make It Move: from a mesh to a garment that plays, in one go, by operators that artists have as well."""

from __future__ import annotations

import os

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from .conftest import ROOT, activate, add_mesh, tube
from .scenes import animate, ended
from .test_panels import drawn

BODY = ROOT / "usd" / "ssilk_usd" / "stages" / "demo_body.usdc"


def test_a_character_that_nothing_moves_gets_the_motions_of_the_demo(ready, monkeypatch):
    from blender_addon.motions.sources import sources
    from blender_addon.operators import demo_motions
    from blender_addon.scene.armature import read_joints
    from blender_addon.scene.objects import scene_units
    from ssilk_core.scene.kinematics import motion_transforms

    bpy, made = ready, []
    read = demo_motions.read_motions
    monkeypatch.setattr(demo_motions, "read_motions", lambda path: made.append(read(path)) or made[-1])
    bpy.ops.wm.usd_import(filepath=str(BODY))
    armature = next(thing for thing in bpy.data.objects if thing.type == "ARMATURE")
    skirt = add_mesh(bpy, "Skirt", *tube(24, 5, (0.6, 1.0), (0.5, 0.3)))
    activate(bpy, skirt)
    bpy.context.scene.frame_start = bpy.context.scene.frame_end = 0  # as an import of a still character leaves it
    assert bpy.ops.ssilk.add_demo_motions() == {"FINISHED"}
    assert bpy.context.scene.frame_end == int(armature.animation_data.action.frame_range[1]) > 20
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


def lines_up(bpy, garment) -> tuple[list[str], object]:
    """Press Make It Move; return the operators that it called, and the garment's training."""
    from blender_addon.operators import make_it_move
    from blender_addon.playback.models import job_of

    called, call = [], make_it_move._call
    try:
        make_it_move._call = lambda name, thing: (called.append(name), call(name, thing))
        assert bpy.ops.ssilk.make_it_move() == {"FINISHED"}
    finally:
        make_it_move._call = call
    return called, job_of(garment)


def test_a_mesh_comes_to_play_while_it_is_trained(ready, skirt, tmp_path, monkeypatch):
    from blender_addon.operators.training import watch
    from blender_addon.panels import GarmentPanel
    from blender_addon.playback import live, playing

    bpy, settings = ready, skirt.ssilk.training
    animate(bpy, bpy.data.objects["Rig"], "Walk", 0.3, 37)
    bpy.context.scene.frame_end = 12
    assert "Save the file first" in refused(bpy)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "skirt.blend"))
    settings.iterations = 4
    called, job = lines_up(bpy, skirt)
    assert called == [f"ssilk.{name}" for name in ("classify", "generate_rig", "find_motions", "train")]
    assert settings.preset == "draft"  # there is no GPU here
    assert [item.name for item in settings.motions if item.use] == ["Walk"]
    assert skirt.ssilk.awaited and not playing.live(skirt)
    assert "Plays as soon as the training has its first model" in " ".join(drawn(GarmentPanel, bpy.context))
    ended(skirt)
    watch()
    first = playing.live(skirt)
    assert first and first.model == job / "model.safetensors" and not skirt.ssilk.awaited
    before = first.written
    os.utime(first.model, (before + 5, before + 5))  # as a better model is written
    with monkeypatch.context() as patch:
        patch.setattr(live, "sample", None)  # the motion is not read again
        watch()
    assert playing.live(skirt) is first and first.written == before + 5 and first.done is None
    playing.stop(skirt)
    settings.preset = "preview"  # what an artist chose stays
    called, again = lines_up(bpy, skirt)
    assert called == ["ssilk.train"] and again != job and settings.preset == "preview"
    assert bpy.ops.ssilk.cancel_training() == {"FINISHED"}
    ended(skirt)
    watch()
    assert not skirt.ssilk.awaited


def test_it_gets_better_until_it_is_finished(ready, skirt, tmp_path, monkeypatch):
    """Rounds of the real training, each resumed from the one before; what is played is the best of them."""
    from blender_addon.operators import training
    from blender_addon.operators.training import watch
    from blender_addon.outside.jobs import read_curve
    from blender_addon.panels import GarmentPanel
    from blender_addon.playback import playing

    bpy, command = ready, training.train_command
    tiny = ["--set", "iterations=4", "--set", "batch=2", "--set", "pretraining_batch=2", "--set", "valid_frames=8"]
    monkeypatch.setattr(training, "train_command", lambda *given: [*command(*given), *tiny])
    animate(bpy, bpy.data.objects["Rig"], "Walk", 0.3, 37)
    bpy.context.scene.frame_end = 4
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "skirt.blend"))
    _, job = lines_up(bpy, skirt)
    state = ended(skirt, until=lambda state: state.round and (state.checkpoint or 0) > 4)
    assert state.alive and state.round == 1 and state.done > 4 and state.spent > 0
    watch()
    assert playing.live(skirt).model == job / "model.safetensors"
    notes = drawn(GarmentPanel, bpy.context)
    assert "ssilk.cancel_training" in notes and "Gets better until you finish it" in " ".join(notes)
    assert "'Skirt' is being trained already" in refused(bpy, bpy.ops.ssilk.train)
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)  # it is found again, though nothing was saved
    garment = bpy.data.objects["Skirt"]
    activate(bpy, garment)
    assert bpy.ops.ssilk.cancel_training() == {"FINISHED"}
    assert ended(garment).state == "stopped"
    points = read_curve(job)["points"]
    assert min(points, key=lambda point: point["validation"]["total"])["iteration"] == ended(garment).checkpoint


def refused(bpy, call=None) -> str:
    with pytest.raises(RuntimeError) as error:
        (call or bpy.ops.ssilk.make_it_move)()
    return str(error.value)


def test_a_step_that_fails_ends_it_and_the_panel_says_why(ready, skirt, tmp_path):
    from blender_addon.operators import make_it_move, tasks
    from blender_addon.panels import GarmentPanel

    bpy = ready
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "skirt.blend"))
    bpy.data.objects.remove(bpy.data.objects["Pillar"])
    assert "No body is bound to 'Rig'" in refused(bpy)
    assert make_it_move.course is None and tasks.failed.startswith("No body is bound to 'Rig'")
    notes = drawn(GarmentPanel, bpy.context)
    assert "No body is bound to 'Rig'" in " ".join(notes) and "ssilk.dismiss_failure" in notes
    assert bpy.ops.ssilk.dismiss_failure() == {"FINISHED"}
    assert "ssilk.dismiss_failure" not in drawn(GarmentPanel, bpy.context)
