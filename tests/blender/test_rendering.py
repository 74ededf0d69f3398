# SPDX-License-Identifier: Apache-2.0
"""Renders with live playback on: each frame shows what a bake shows, with the extension and without."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from .scenes import proxies_of, shown

FRAMES = (3, 17, 18, 36)
PIXELS = 96


@pytest.fixture
def stage(ready, trained):
    """The trained skirt before a camera, for flat renders."""
    import addon_utils

    scene = ready.context.scene
    addon_utils.enable("cycles")
    camera = ready.data.objects.new("Camera", ready.data.cameras.new("Camera"))
    camera.location, camera.rotation_euler = (0, -4, 1.0), (np.pi / 2, 0, 0)
    scene.collection.objects.link(camera)
    scene.camera = camera
    material = ready.data.materials.new("White")
    for thing in (trained, ready.data.objects["Pillar"]):
        thing.data.materials.append(material)
    world = ready.data.worlds.new("World")
    world.color = (1, 1, 1)
    scene.world = world
    light = ready.data.objects.new("Sun", ready.data.lights.new("Sun", "SUN"))
    light.rotation_euler = (0.9, 0.2, 0)
    scene.collection.objects.link(light)
    scene.render.engine, scene.cycles.samples, scene.cycles.seed = "CYCLES", 1, 1
    scene.cycles.use_denoising = False
    scene.render.resolution_x = scene.render.resolution_y = PIXELS
    scene.render.image_settings.file_format = "PNG"
    return trained


def rendered(bpy, folder, *, motion_blur: bool = False) -> np.ndarray:
    """Return rendered frames, shape (F, PIXELS, PIXELS, 4)."""
    scene, found = bpy.context.scene, []
    scene.render.use_motion_blur = motion_blur
    for frame in FRAMES:
        scene.frame_set(1)  # what the viewport shows is another frame
        scene.frame_current = frame
        scene.render.filepath = str(folder / f"{frame}.png")
        bpy.ops.render.render(write_still=True)
        image = bpy.data.images.load(scene.render.filepath)
        found.append(np.array(image.pixels).reshape(PIXELS, PIXELS, 4))
        bpy.data.images.remove(image)
    return np.array(found)


def animation(bpy, folder) -> np.ndarray:
    """Return frames of a rendered animation, shape (F, PIXELS, PIXELS, 4)."""
    scene, found = bpy.context.scene, []
    scene.render.filepath, scene.frame_step = str(folder / "a"), 7
    bpy.ops.render.render(animation=True)
    for path in sorted(folder.glob("a*.png")):
        image = bpy.data.images.load(str(path))
        found.append(np.array(image.pixels).reshape(PIXELS, PIXELS, 4))
        bpy.data.images.remove(image)
    return np.array(found)


@pytest.fixture
def baked(ready, stage, folder, tmp_path):
    """The rendered frames of a bake, with motion blur and without, and the animation's; nothing is baked by then."""
    path = folder / "wanted.npz"
    if not path.exists():
        assert ready.ops.ssilk.bake() == {"FINISHED"}
        blurred = rendered(ready, tmp_path, motion_blur=True)
        sharp = rendered(ready, tmp_path)
        (tmp_path / "baked").mkdir()
        np.savez(path, sharp=sharp, blurred=blurred, animation=animation(ready, tmp_path / "baked"))
        assert ready.ops.ssilk.remove_bake() == {"FINISHED"}
    return np.load(path)


def away(some: np.ndarray, others: np.ndarray) -> float:
    """Return how many of the pixels differ visibly."""
    return float((np.abs(some - others).max(-1) > 0.02).mean())


@pytest.mark.parametrize("lock", [False, True])
def test_rendered_frames_show_what_a_bake_shows(ready, stage, baked, tmp_path, lock):
    ready.context.scene.render.use_lock_interface = lock
    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    assert away(baked["sharp"][0], baked["sharp"][-1]) > 0.02
    assert away(rendered(ready, tmp_path), baked["sharp"]) < 1e-3


def test_animations_and_motion_blur_show_what_a_bake_shows(ready, stage, baked, tmp_path):
    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    assert away(rendered(ready, tmp_path, motion_blur=True), baked["blurred"]) < 1e-3
    ready.context.scene.render.use_motion_blur = False
    frames = animation(ready, tmp_path)
    assert len(frames) == 6 and away(frames, baked["animation"]) < 1e-3


@pytest.mark.parametrize("enabled", [True, False])
def test_saved_files_render_alike_with_the_extension_and_without(ready, stage, baked, tmp_path, enabled):
    """As farms render them. Without it, no handler runs: so does a render beside an unlocked interface."""
    import addon_utils

    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    ready.ops.wm.save_as_mainfile(filepath=str(tmp_path / "live.blend"), copy=True)
    if not enabled:
        addon_utils.disable("blender_addon", default_set=True)
    try:
        ready.ops.wm.open_mainfile(filepath=str(tmp_path / "live.blend"))
        assert away(rendered(ready, tmp_path), baked["sharp"]) < 1e-3
        assert away(animation(ready, tmp_path), baked["animation"]) < 1e-3
    finally:
        assert addon_utils.enable("blender_addon", default_set=True)


def test_a_file_without_its_model_renders_what_was_played(ready, stage, baked, tmp_path):
    import shutil

    from blender_addon.playback import playing
    from blender_addon.playback.models import model_of

    model = shutil.copy(model_of(stage), tmp_path / "model.safetensors")
    stage.ssilk.model = str(model)
    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    ready.ops.wm.save_as_mainfile(filepath=str(tmp_path / "live.blend"), copy=True)
    (tmp_path / "model.safetensors").unlink()
    ready.ops.wm.open_mainfile(filepath=str(tmp_path / "live.blend"))
    garment = ready.data.objects["Skirt"]
    assert playing.live(garment) is None and "has no model" in playing.reason(garment)
    assert away(rendered(ready, tmp_path), baked["sharp"]) < 1e-3


def test_edits_of_which_nothing_told_are_read_before_the_first_frame(ready, stage, tmp_path):
    """A constraint's target moves, which Blender tells of as of any other object."""
    armature = ready.data.objects["Rig"]
    target = ready.data.objects.new("Target", None)
    ready.context.collection.objects.link(target)
    constraint = armature.pose.bones["Spine"].constraints.new("COPY_ROTATION")
    constraint.target, constraint.target_space = target, "LOCAL"
    constraint.owner_space = "LOCAL"
    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    target.rotation_euler = (0.4, 0.2, 0.3)
    live = rendered(ready, tmp_path)
    assert ready.ops.ssilk.bake() == {"FINISHED"}
    assert away(live, rendered(ready, tmp_path)) < 1e-3


def test_a_frame_that_was_not_read_is_told(ready, stage, tmp_path, capfd):
    from blender_addon.playback import playing

    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    rendered(ready, tmp_path)
    assert not playing.warning(stage)
    ready.context.scene.frame_end = 20
    rendered(ready, tmp_path)
    assert "Frame 36 was rendered with another pose" in playing.warning(stage)
    assert "Frame 36 was rendered with another pose" in capfd.readouterr().out


def test_a_render_in_another_thread_waits_until_the_main_one_has_read(ready, stage):
    """As beside an unlocked interface: its first frame comes after the keys of what the armature does by now."""
    import threading
    import time

    from blender_addon.playback import playing

    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    live, first = playing.live(stage), playing.live(stage).rolled.placed.copy()
    ready.data.objects["Rig"].animation_data.action = ready.data.actions["Spin Ö"]
    render = threading.Thread(target=playing._render_began, args=(ready.context.scene,))
    render.start()
    time.sleep(0.2)
    assert render.is_alive() and not playing._rendering
    while render.is_alive():
        playing._read()
        time.sleep(0.001)
    try:
        assert playing._rendering and playing._read() == playing.PATIENCE
        assert not live.stale and np.abs(live.rolled.placed - first).max() > 0.1
    finally:
        playing._render_ended()
    spun = shown(ready, stage, range(1, 41))
    assert ready.ops.ssilk.bake() == {"FINISHED"}
    np.testing.assert_allclose(shown(ready, stage, range(1, 41)), spun, atol=2e-5)


def test_undo_takes_live_playback_back_and_redo_dresses_again(ready, stage):
    from blender_addon.playback import playing

    ready.context.preferences.edit.use_global_undo = True
    ready.ops.ed.undo_push(message="before")
    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    ready.ops.ed.undo_push(message="Play Live")
    right = shown(ready, stage, range(1, 41))
    ready.ops.ed.undo()
    garment = ready.data.objects["Skirt"]
    assert playing.live(garment) is None and not playing.reason(garment)
    assert not garment.data.shape_keys
    ready.ops.ed.redo()
    garment = ready.data.objects["Skirt"]
    np.testing.assert_allclose(shown(ready, garment, range(1, 41)), right, atol=2e-5)


def test_what_an_undo_took_from_a_garment_that_is_played_comes_back(ready, stage):
    from blender_addon.motions.keys import remove_keys
    from blender_addon.playback import playing
    from blender_addon.playback.bake import animated
    from blender_addon.scene.meshes import remove_shapes

    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    right = shown(ready, stage, range(1, 41))
    remove_keys(stage, animated(stage, ready.data.objects["Rig"]))
    remove_shapes(stage)
    playing._undone()
    assert playing.live(stage) and not playing.reason(stage)
    np.testing.assert_allclose(shown(ready, stage, range(1, 41)), right, atol=2e-5)


def test_keys_of_live_playback_go_when_it_stops_and_a_bake_stays(ready, stage):
    from blender_addon.motions.keys import is_live

    armature = ready.data.objects["Rig"]
    assert ready.ops.ssilk.bake() == {"FINISHED"}
    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    assert [track.name for track in armature.animation_data.nla_tracks] == ["SSILK Skirt", "SSILK Skirt live"]
    ready.context.scene.frame_set(20)
    assert ready.ops.ssilk.stop_live() == {"FINISHED"}
    assert [track.name for track in armature.animation_data.nla_tracks] == ["SSILK Skirt"]
    assert not any(map(is_live, ready.data.actions))
    assert len(proxies_of(ready)) == 6
