# SPDX-License-Identifier: Apache-2.0
"""Garments that are held and let go, and poses on twos: as Blender evaluates them, baked and played live."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from blender_addon.playback.models import model_of

from .conftest import activate
from .scenes import decoded, shown
from .test_baking import refused

FRAMES = range(1, 41)
NEAR = 2e-5  # [m]


def key(garment, values: dict[int, float]) -> None:
    for frame, value in values.items():
        garment.ssilk.free = value
        garment.ssilk.keyframe_insert("free", frame=frame)


def bake(bpy, garment) -> np.ndarray:
    activate(bpy, garment)
    assert bpy.ops.ssilk.bake() == {"FINISHED"}
    return shown(bpy, garment, FRAMES)


def live(bpy, garment) -> np.ndarray:
    activate(bpy, garment)
    assert bpy.ops.ssilk.play_live() == {"FINISHED"}
    return shown(bpy, garment, FRAMES)


def test_a_keyed_slider_holds_the_garment_and_lets_it_go_baked_and_live(ready, trained, tmp_path, ssilk_python):
    free = bake(ready, trained)
    skinned = decoded(ssilk_python, model_of(trained), tmp_path, lbs=True)
    key(trained, {10: 0.0, 20: 1.0})
    held = bake(ready, trained)
    off = np.sqrt(((held - skinned) ** 2).sum(axis=-1).mean(axis=-1))
    apart = np.sqrt(((free - skinned) ** 2).sum(axis=-1).mean(axis=-1))
    assert off[:10].max() < 0.01 < 2 * 0.01 < apart[:10].max()
    assert (np.diff(off[9:19]) > 0).all() and off[19:].min() > 0.01
    steps = [np.linalg.norm(np.diff(each, axis=0), axis=-1).max() for each in (held, free, skinned)]
    assert steps[0] < max(steps[1:]) + np.linalg.norm(free - skinned, axis=-1).max() / 10 + 0.01
    assert np.abs(live(ready, trained) - held).max() < NEAR
    key(trained, {10: 1.0})
    ready.ops.ssilk.refresh_live()
    assert np.abs(shown(ready, trained, FRAMES) - free).max() < NEAR


def test_a_slider_without_keys_holds_all_frames_and_is_followed_live(ready, trained, tmp_path, ssilk_python):
    free = live(ready, trained)
    trained.ssilk.free = 0.0
    shown(ready, trained, range(1, 2))
    ready.ops.ssilk.refresh_live()
    held = shown(ready, trained, FRAMES)
    assert np.abs(bake(ready, trained) - held).max() < NEAR
    skinned = decoded(ssilk_python, model_of(trained), tmp_path, lbs=True)
    assert np.sqrt(((held - skinned) ** 2).sum(axis=-1).mean()) < 0.01 < np.abs(free - skinned).max()


def test_poses_on_twos_are_held_baked_and_live(ready, trained):
    bones = [bone for bone in ready.data.objects["Rig"].pose.bones if bone.name.startswith("Skirt_proxy")]

    def turns() -> np.ndarray:
        found = []
        for frame in FRAMES:
            ready.context.scene.frame_set(frame)
            found.append([tuple(bone.rotation_quaternion) for bone in bones])
        return np.array(found)

    trained.ssilk.hold = 2
    baked = bake(ready, trained)
    held = turns()
    np.testing.assert_array_equal(held[::2], held[1::2])
    assert (np.abs(np.diff(held[::2], axis=0)).max(axis=(1, 2)) > 1e-5).all()
    assert np.abs(live(ready, trained) - baked).max() < NEAR
    assert "A solver moves each frame: set Hold Frames to 1" in refused(ready, trained, quality="hero")


def test_edits_of_a_held_garment_are_followed(ready, trained):
    key(trained, {10: 0.0, 20: 1.0})
    live(ready, trained)
    spine = ready.data.objects["Rig"].pose.bones["Spine"]
    spine.rotation_quaternion = (1, 0.5, 0.3, 0)
    spine.keyframe_insert("rotation_quaternion", frame=5)
    stale = shown(ready, trained, range(1, 10))
    ready.ops.ssilk.refresh_live()
    np.testing.assert_allclose(shown(ready, trained, range(1, 10)), stale, atol=1e-4)


def cycle(bpy, frames: int = 24) -> None:
    """Let the hips sway and turn in place, in a cycle whose last frame shows the first one's pose."""
    hips = bpy.data.objects["Rig"].pose.bones["Hips"]
    action = bpy.data.actions.new("Cycle")
    bpy.data.objects["Rig"].animation_data.action = action
    for frame in range(1, frames + 2):
        phase = 2 * np.pi * (frame - 1) / frames
        hips.location = (0.15 * np.sin(phase), 0.0, 0.05 * np.sin(2 * phase))
        hips.rotation_quaternion = (np.cos(0.3 * np.sin(phase)), 0.0, np.sin(0.3 * np.sin(phase)), 0.0)
        hips.keyframe_insert("location", frame=frame)
        hips.keyframe_insert("rotation_quaternion", frame=frame)
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = 1, frames + 1


def test_a_cycle_is_baked_as_a_loop(ready, trained, capfd):
    cycle(ready)

    def apart(**options) -> float:
        activate(ready, trained)
        assert ready.ops.ssilk.bake(**options) == {"FINISHED"}
        first, last = shown(ready, trained, [1, 25])
        return float(np.abs(last - first).max())

    at_rest = apart(pre_roll=0.0)
    trained.ssilk.loop = True
    capfd.readouterr()
    looped = apart()
    assert looped < 1e-6 < 1e-5 < at_rest  # by as much as this toy remembers of where it started
    assert "the loop's last frame is within" in capfd.readouterr().out
    assert "A solver does not come back to its start: switch Loop off" in refused(ready, trained, quality="hero")


def test_proxies_are_held_and_posed_each_by_itself(ready, trained):
    """A proxy that hangs from a bone of the character is where an action poses it, and the garment's others move."""
    rig = ready.data.objects["Rig"]
    free = bake(ready, trained)
    bone = next(
        bone
        for bone in rig.pose.bones
        if bone.name.startswith("Skirt_proxy") and bone.parent.name in ("Hips", "Spine")
    )
    bone.ssilk_posed = 1.0
    assert "Choose the action that poses proxies by hand" in refused(ready, trained)
    played = rig.animation_data.action
    by_hand = ready.data.actions.new("By Hand")
    rig.animation_data.action = by_hand
    bone.location, bone.rotation_quaternion = (0.1, 0.2, 0.0), (0.8, 0.6, 0.0, 0.0)
    for path in ("location", "rotation_quaternion"):
        bone.keyframe_insert(path, frame=1)
    rig.animation_data.action = played
    bone.location, bone.rotation_quaternion = (0, 0, 0), (1, 0, 0, 0)
    trained.ssilk.hand_pose = by_hand
    for frame, value in {10: 0.0, 20: 1.0}.items():
        bone.ssilk_posed = value
        bone.keyframe_insert("ssilk_posed", frame=frame)
    posed = bake(ready, trained)
    assert np.abs(posed[:10] - free[:10]).max() < NEAR and np.abs(posed[19:] - free[19:]).max() > 0.05
    assert abs(np.dot(bone.rotation_quaternion, (0.8, 0.6, 0, 0))) == pytest.approx(1, abs=1e-6)
    np.testing.assert_allclose(bone.location, (0.1, 0.2, 0), atol=1e-4)


def test_a_vertex_group_is_held(ready, trained):
    every = [vertex.index for vertex in trained.data.vertices]
    trained.vertex_groups.new(name="All of it").add(every, 1.0, "REPLACE")
    trained.ssilk.part, trained.ssilk.part_free = "All of it", 0.0
    apart = bake(ready, trained)
    trained.ssilk.part, trained.ssilk.free = "", 0.0
    assert np.abs(bake(ready, trained) - apart).max() < 1e-4
