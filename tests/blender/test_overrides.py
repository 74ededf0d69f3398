# SPDX-License-Identifier: Apache-2.0
"""What overrides a bake is told by name, with how far off Blender shows the garment; proxies are out of the way."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from .conftest import activate
from .scenes import proxies_of, shown

FRAMES = range(1, 41)


@pytest.fixture
def baked(ready, trained, folder):
    """The skirt with a bake."""
    from .conftest import opened

    if not opened(ready, folder / "baked.blend"):
        assert ready.ops.ssilk.bake() == {"FINISHED"}
        ready.ops.wm.save_as_mainfile(filepath=str(folder / "baked.blend"))
    activate(ready, ready.data.objects["Skirt"])
    return ready.data.objects["Skirt"]


def select_all_and_key(bpy, armature) -> None:
    """Do what animators do: all bones in pose mode, insert keys."""
    activate(bpy, armature)
    bpy.ops.object.mode_set(mode="POSE")
    bpy.ops.pose.select_all(action="SELECT")
    for bone in bpy.context.selected_pose_bones:
        bone.keyframe_insert("rotation_quaternion", frame=9)
    bpy.ops.object.mode_set(mode="OBJECT")


def test_select_all_and_insert_keys_passes_the_proxies_by(ready, baked):
    before = shown(ready, baked, FRAMES)
    armature = ready.data.objects["Rig"]
    ready.context.scene.frame_set(9)
    select_all_and_key(ready, armature)
    np.testing.assert_allclose(shown(ready, baked, FRAMES), before, atol=1e-4)
    proxies = [armature.pose.bones[name] for name in proxies_of(ready)]
    assert all(all(bone.lock_location) and all(bone.lock_rotation) and bone.lock_rotation_w for bone in proxies)


def test_proxies_that_are_wanted_stay_and_come_back_without_the_bake(ready, baked):
    armature = ready.data.objects["Rig"]
    collection = armature.data.collections["Skirt proxies"]
    assert not collection.is_visible
    collection.is_visible = True
    assert ready.ops.ssilk.bake() == {"FINISHED"}
    assert collection.is_visible
    assert ready.ops.ssilk.remove_bake() == {"FINISHED"}
    assert collection.is_visible
    assert not any(any(armature.pose.bones[name].lock_rotation) for name in proxies_of(ready))


def override_by_action(bpy, garment) -> None:
    armature = bpy.data.objects["Rig"]
    armature.data.collections["Skirt proxies"].is_visible = True
    bpy.context.scene.frame_set(1)
    for name in proxies_of(bpy):
        armature.pose.bones[name].rotation_quaternion = (0.8, 0.6, 0, 0)
    select_all_and_key(bpy, armature)


def override_by_strip(bpy, garment) -> None:
    armature = bpy.data.objects["Rig"]
    action = armature.animation_data.action
    override_by_action(bpy, garment)
    armature.animation_data.action = None
    armature.animation_data.nla_tracks.new().strips.new("Above", 1, action).name = "Above"  # 4.5: the action's


def override_by_constraint(bpy, garment) -> None:
    target = bpy.data.objects.new("Target", None)
    bpy.context.collection.objects.link(target)
    target.rotation_euler = (1, 1, 0)
    bpy.data.objects["Rig"].pose.bones[proxies_of(bpy)[0]].constraints.new("COPY_ROTATION").target = target


def override_by_driver(bpy, garment) -> None:
    bone = bpy.data.objects["Rig"].pose.bones[proxies_of(bpy)[0]]
    bone.driver_add("rotation_quaternion", 1).driver.expression = "0.7"


def override_by_muting(bpy, garment) -> None:
    bpy.data.objects["Rig"].animation_data.nla_tracks["SSILK Skirt"].mute = True


def override_by_pin(bpy, garment) -> None:
    garment.active_shape_key_index, garment.show_only_shape_key = 1, True


def override_by_switching_off(bpy, garment) -> None:
    garment.modifiers[0].show_viewport = False


@pytest.mark.parametrize(
    ("override", "told"),
    [
        (override_by_action, "keys of the action 'Walk' on 6 proxies"),
        (override_by_strip, "the strip 'Above' of the track"),
        (override_by_constraint, "constraints on 'Skirt_proxy"),
        (override_by_driver, "drivers on 'Skirt_proxy"),
        (override_by_muting, "the track 'SSILK Skirt' is muted"),
        (override_by_pin, "one shape key of 'Skirt' is pinned"),
        (override_by_switching_off, "is switched off in viewports"),
    ],
)
def test_a_bake_says_what_blender_shows_in_its_place(ready, baked, capfd, override, told):
    from blender_addon.panels.playback import overridden_line

    assert not overridden_line(baked)
    right = shown(ready, baked, FRAMES)
    override(ready, baked)
    assert told in overridden_line(baked)
    away = np.linalg.norm(shown(ready, baked, FRAMES) - right, axis=-1).max()
    activate(ready, baked)
    capfd.readouterr()
    assert ready.ops.ssilk.bake() == {"FINISHED"}
    report = capfd.readouterr().out
    assert told in report and "mm off at frame" in report and "Warning" in report
    if override is override_by_action:  # every frame is off alike: the figure is what Blender shows
        figure = float(report.partition("Blender shows it ")[2].partition(" mm")[0])
        assert 0.5 * away < figure / 1000 <= 1.02 * away


def test_a_bake_that_shows_tells_of_nothing(ready, baked, capfd):
    assert ready.ops.ssilk.bake() == {"FINISHED"}
    assert "mm off" not in capfd.readouterr().out


def test_a_solo_track_is_refused_in_words(ready, baked):
    tracks = ready.data.objects["Rig"].animation_data.nla_tracks
    other = tracks.new()
    other.strips.new("Spin", 1, ready.data.actions["Spin Ö"])
    other.is_solo = True
    with pytest.raises(RuntimeError, match="is solo, so that baked keys would not show"):
        ready.ops.ssilk.bake()
    from blender_addon.panels.playback import overridden_line

    assert "is solo" in overridden_line(baked)
