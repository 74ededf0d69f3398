# SPDX-License-Identifier: Apache-2.0
"""What is sampled is what Blender shows in the artist's scene, whatever drivers read; what differs is refused."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from .conftest import BONES, activate
from .scenes import shown, weights_of

FRAMES = range(1, 13)


def by_frame(bpy, driver) -> None:
    variable = driver.variables.new()
    variable.name, target = "now", variable.targets[0]
    target.id_type, target.id, target.data_path = "SCENE", bpy.context.scene, "frame_current"
    driver.expression = "now / 10"


def by_property(bpy, driver) -> None:
    scene = bpy.context.scene
    scene["lean"] = 0.3
    scene.keyframe_insert('["lean"]', frame=1)
    scene["lean"] = 0.9
    scene.keyframe_insert('["lean"]', frame=12)
    variable = driver.variables.new()
    variable.name, target = "lean", variable.targets[0]
    target.id_type, target.id, target.data_path = "SCENE", scene, '["lean"]'
    driver.expression = "lean"


def by_context(bpy, driver) -> None:
    bpy.context.scene["lean"] = 0.7
    variable = driver.variables.new()
    variable.name, variable.type = "lean", "CONTEXT_PROP"
    variable.targets[0].context_property, variable.targets[0].data_path = "ACTIVE_SCENE", '["lean"]'
    driver.expression = "lean"


def by_python(bpy, driver) -> None:
    bpy.context.scene.frame_set(1)
    driver.expression = "bpy.context.scene.frame_current / 12"


def by_time(bpy, driver) -> None:
    driver.expression = "frame / 10"


@pytest.mark.parametrize("stretch", [100, 50, 230])
@pytest.mark.parametrize("drive", [by_frame, by_property, by_context, by_python, by_time])
def test_sampled_poses_are_those_of_the_artists_scene(bpy, skirt, drive, stretch):
    from blender_addon.motions.sampling import prepare_takes, sample, worlds
    from blender_addon.motions.sources import TIMELINE, Source
    from blender_addon.scene.armature import read_joints

    armature, scene = bpy.data.objects["Rig"], bpy.context.scene
    scene.frame_start, scene.frame_end, scene.render.frame_map_new = 1, 12, stretch
    spine = armature.pose.bones["Spine"]
    spine.rotation_mode = "XYZ"
    drive(bpy, spine.driver_add("rotation_euler", 0).driver)
    for frame, place in ((1, 0.0), (12, 1.0)):
        armature.pose.bones["Hips"].location.x = place
        armature.pose.bones["Hips"].keyframe_insert("location", frame=frame)
    right = []
    for frame in FRAMES:
        scene.frame_set(frame)
        right.append(worlds(armature.evaluated_get(bpy.context.evaluated_depsgraph_get())))
    assert np.ptp(right, axis=0).max() > 0.2
    scene.frame_set(5)
    (take,) = prepare_takes(armature, [Source(TIMELINE, "Timeline")])
    joints = read_joints(armature, skirt).character
    assert list(sample(armature, joints, [take])) and joints.names == BONES
    np.testing.assert_allclose(take.worlds, right, atol=1e-5)
    assert scene.frame_current == 5
    assert [item.name for item in bpy.data.scenes] == ["Scene"]


def test_bakes_and_live_playback_follow_stretched_time(ready, trained):
    """At half the speed every second frame shows, to the model's own time apart, what the keys of both hold."""
    from blender_addon.playback import playing

    ready.context.scene.render.frame_map_new = 200
    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    live = shown(ready, trained, range(1, 41))
    assert not playing.live(trained).stale
    ready.ops.ssilk.stop_live()
    assert ready.ops.ssilk.bake() == {"FINISHED"}
    np.testing.assert_allclose(shown(ready, trained, range(1, 41)), live, atol=5e-5)


def test_other_frames_and_rates_are_told_in_the_panel(ready, trained):
    from blender_addon.panels.playback import live_line

    scene = ready.context.scene
    for change, back in (
        (lambda: setattr(scene, "frame_end", 60), lambda: setattr(scene, "frame_end", 40)),
        (lambda: setattr(scene, "frame_start", 3), lambda: setattr(scene, "frame_start", 1)),
        (lambda: setattr(scene.render, "fps", 12), lambda: setattr(scene.render, "fps", 24)),
        (lambda: setattr(scene.render, "frame_map_new", 50), lambda: setattr(scene.render, "frame_map_new", 100)),
    ):
        back()
        assert ready.ops.ssilk.play_live() == {"FINISHED"}
        assert live_line(trained) == "Follows the armature"
        change()
        assert "changed since the motion was read" in live_line(trained)
        assert ready.ops.ssilk.refresh_live() == {"FINISHED"}
        assert live_line(trained) == "Follows the armature"
        ready.ops.ssilk.stop_live()


def test_linked_duplicates_are_refused_before_anything_changes(ready, trained):
    twin = trained.copy()
    twin.name = "Twin"
    ready.context.collection.objects.link(twin)
    before = shown(ready, twin, [20]), weights_of(twin)
    activate(ready, trained)
    for use in (ready.ops.ssilk.play_live, ready.ops.ssilk.bake):
        with pytest.raises(RuntimeError, match="'Skirt' shares its mesh with 'Twin', which would change with it"):
            use()
    np.testing.assert_array_equal(shown(ready, twin, [20]), before[0])
    trained.data = trained.data.copy()
    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    assert not twin.data.shape_keys
    np.testing.assert_array_equal(weights_of(twin), before[1])


def test_a_body_that_preserves_its_volume_is_refused(ready, trained):
    """Blender shows it elsewhere than the skin that cloth collides with."""
    pillar = ready.data.objects["Pillar"]
    pillar.vertex_groups["Spine"].add(range(len(pillar.data.vertices)), 0.5, "REPLACE")
    plain = shown(ready, pillar, [20])
    pillar.modifiers[0].use_deform_preserve_volume = True
    assert np.abs(shown(ready, pillar, [20]) - plain).max() > 1e-3
    activate(ready, trained)
    for use in (ready.ops.ssilk.play_live, ready.ops.ssilk.bake, ready.ops.ssilk.generate_rig):
        with pytest.raises(RuntimeError, match="'Armature' of 'Pillar' uses Preserve Volume; switch that off"):
            use()
