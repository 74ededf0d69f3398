# SPDX-License-Identifier: Apache-2.0
"""Wind fields and the scene's gravity: live playback and bakes feel them alike."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from .conftest import activate
from .scenes import shown

EXACT = 2e-5  # [m]
FRAMES = range(1, 41)


@pytest.fixture
def fan(ready, trained):
    """A wind of 6 m/s along Blender's x axis."""
    ready.ops.object.effector_add(type="WIND", rotation=(0, np.pi / 2, 0))
    made = ready.context.object
    made.field.strength = 6.0
    activate(ready, trained)
    yield made
    ready.data.objects.remove(made)


def live(ready, trained) -> np.ndarray:
    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    found = shown(ready, trained, FRAMES)
    assert ready.ops.ssilk.stop_live() == {"FINISHED"}
    return found


def test_wind_moves_what_is_played_as_it_moves_a_bake(ready, trained, fan):
    fan.hide_viewport = True
    still = live(ready, trained)
    fan.hide_viewport = False
    blown = live(ready, trained)
    assert (blown - still)[..., 0].mean() > 1e-3
    assert ready.ops.ssilk.bake() == {"FINISHED"}
    baked = shown(ready, trained, FRAMES)
    assert np.abs(baked - blown).max() < EXACT


def test_a_fan_that_turns_and_gravity_that_is_keyed_are_read_over_time(ready, trained, fan):
    from blender_addon.motions.world import signature, world_over

    scene = ready.context.scene
    assert world_over(scene, range(1, 5), 24.0).gravity is None
    before = signature(scene)
    fan.field.strength = 3.0
    assert signature(scene) != before
    fan.keyframe_insert("rotation_euler", frame=1)
    fan.rotation_euler = (0, 0, 0)
    fan.keyframe_insert("rotation_euler", frame=4)
    scene.gravity = (0, 0, -9.81)
    scene.keyframe_insert("gravity", frame=1)
    scene.gravity = (0, 4.0, 0)
    scene.keyframe_insert("gravity", frame=4)
    try:
        world = world_over(scene, range(1, 5), 24.0)
        np.testing.assert_allclose(world.air.velocity[[0, -1]], [[3, 0, 0], [0, 3, 0]], atol=1e-5)
        np.testing.assert_allclose(world.gravity[[0, -1]], [[0, -9.81, 0], [0, 0, -4]], atol=1e-5)
    finally:
        scene.animation_data_clear()
        scene.gravity = (0, 0, -9.81)


def test_without_gravity_cloth_weighs_nothing_and_turbulence_is_gusts(ready, trained, fan):
    from blender_addon.motions.world import world_over

    scene = ready.context.scene
    fan.field.type, fan.field.size, fan.field.seed = "TURBULENCE", 0.5, 7
    scene.use_gravity = False
    try:
        world = world_over(scene, range(1, 3), 24.0)
    finally:
        scene.use_gravity = True
    np.testing.assert_array_equal(world.gravity, np.zeros((1, 3)))
    assert (world.air.gusts.tolist(), world.air.length, world.air.seed) == ([6.0], 0.5, 7)
    assert not world.air.velocity.any()


def test_what_blender_leaves_out_or_cannot_point_anywhere_does_not_blow(ready, trained, fan):
    """Blender's own cloth stands still under each of these fields, too."""
    from blender_addon.motions.world import signature, world_over

    scene, layer = ready.context.scene, ready.context.view_layer
    off = ready.data.collections.new("off")
    scene.collection.children.link(off)
    home = fan.users_collection[0]
    off.objects.link(fan)
    home.objects.unlink(fan)
    blown, there = world_over(scene, range(1, 3), 24.0), layer.layer_collection.children["off"]
    before = signature(scene)
    try:
        assert blown.air.velocity[0, 0] == pytest.approx(6.0)
        there.exclude = True
        layer.update()
        assert world_over(scene, range(1, 3), 24.0) is None and signature(scene) != before
        there.exclude, off.hide_viewport = False, True
        layer.update()
        assert world_over(scene, range(1, 3), 24.0) is None and signature(scene) != before
        off.hide_viewport = False
        there.hide_viewport = True  # the eye, which hides and does not disable
        assert world_over(scene, range(1, 3), 24.0).air.velocity[0, 0] == pytest.approx(6.0)
        there.hide_viewport, fan.scale = False, (1, 1, 0)
        layer.update()
        assert world_over(scene, range(1, 3), 24.0) is None
    finally:
        home.objects.link(fan)
        ready.data.collections.remove(off)


def test_a_field_that_blows_too_fast_is_named(ready, trained, fan):
    fan.field.strength = 300.0
    with pytest.raises(
        RuntimeError, match=f"'{fan.name}' blow with up to 300 m/s; lower the strength, 100 m/s at most"
    ):
        ready.ops.ssilk.play_live()


def test_an_edit_of_a_field_that_moves_is_noticed_and_driven_gravity_is_refused(ready, trained, fan):
    from blender_addon.errors import SetupError
    from blender_addon.motions.world import signature, world_over

    scene = ready.context.scene
    fan.keyframe_insert("rotation_euler", frame=1)
    fan.rotation_euler = (0, 0, 0)
    fan.keyframe_insert("rotation_euler", frame=9)
    before = signature(scene)
    fan.field.strength += 2
    assert signature(scene) != before
    scene.driver_add("gravity", 2).driver.expression = "-frame"
    try:
        scene.frame_set(3)
        before = signature(scene)
        scene.frame_set(7)
        assert signature(scene) == before
        with pytest.raises(SetupError, match="is driven or on NLA tracks"):
            world_over(scene, range(1, 3), 24.0)
    finally:
        scene.animation_data_clear()
        scene.gravity = (0, 0, -9.81)
        scene.frame_set(1)
