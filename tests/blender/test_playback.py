# SPDX-License-Identifier: Apache-2.0
"""Live playback: what is seen is what a bake shows, from wherever the artist comes."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from blender_addon.playback.models import model_of

from .conftest import activate
from .scenes import decoded, enliven, shown
from .test_panels import drawn

EXACT = 2e-5  # [m]
FRAMES = range(1, 41)


@pytest.fixture
def wanted(ready, trained, folder, ssilk_python) -> np.ndarray:
    """What the decoder says of every frame, by `ssilk bake`."""
    path = folder / "wanted.npy"
    if not path.exists():
        assert ready.ops.ssilk.bake() == {"FINISHED"}
        np.save(path, decoded(ssilk_python, model_of(trained), folder, pre_roll=1.0))
        assert ready.ops.ssilk.remove_bake() == {"FINISHED"}
    return np.load(path)


def playing():
    from blender_addon.playback import playing

    return playing


def test_every_frame_shows_what_a_bake_would(ready, trained, wanted):
    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    assert np.abs(shown(ready, trained, FRAMES) - wanted).max() < EXACT
    assert np.ptp(wanted, axis=0).max() > 0.05
    assert not playing().live(trained).stale


def test_what_live_playback_does_not_follow_is_told(ready, trained, capfd):
    ready.data.objects["Pillar"].modifiers.new("Late", "SMOOTH")
    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    assert "The modifier 'Late' of 'Pillar' comes after its bones" in capfd.readouterr().out


def test_the_panel_says_what_live_playback_is_at(ready, trained):
    from blender_addon.panels.playback import PlaybackPanel

    assert drawn(PlaybackPanel, ready.context) == ["ssilk.play_live", "live_quality"]
    ready.ops.ssilk.play_live()
    live = playing().live(trained)
    buttons = ["ssilk.stop_live", "ssilk.refresh_live", "live_quality"]
    assert drawn(PlaybackPanel, ready.context) == [*buttons, "Follows the armature"]
    live.stale = True
    assert drawn(PlaybackPanel, ready.context)[-1] == "The motion changed since it was read"
    live.refresh()
    assert drawn(PlaybackPanel, ready.context)[-1] == "Reading the motion: 0%"
    live.read()
    assert drawn(PlaybackPanel, ready.context)[-1].startswith("Reading the motion: ")


def test_scrubbing_shows_the_same_bits_as_playing(ready, trained):
    ready.ops.ssilk.play_live()
    played = shown(ready, trained, FRAMES)
    order = np.random.default_rng(0).permutation(FRAMES)
    ready.ops.ssilk.stop_live()
    ready.ops.ssilk.play_live()
    for frame in order:
        np.testing.assert_array_equal(shown(ready, trained, [int(frame)])[0], played[frame - 1])


def test_a_model_that_a_training_renews_is_taken_up(ready, trained, ssilk_python, tmp_path):
    from blender_addon.operators.training import watch

    model = tmp_path / "renewed.safetensors"
    model.write_bytes(model_of(trained).read_bytes())
    trained.ssilk.model = str(model)
    ready.ops.ssilk.play_live()
    before = shown(ready, trained, FRAMES)
    watch()
    np.testing.assert_array_equal(shown(ready, trained, FRAMES), before)
    enliven(ssilk_python, model)  # once more, so that shapes and weights become others
    watch()
    after = shown(ready, trained, FRAMES)
    assert np.abs(after - before).max() > 1e-3
    ready.ops.ssilk.stop_live()
    ready.ops.ssilk.play_live()
    np.testing.assert_allclose(shown(ready, trained, FRAMES), after, atol=1e-6)


def test_outside_the_range_the_garment_is_held(ready, trained):
    ready.ops.ssilk.play_live()
    trained.name = ready.data.objects["Rig"].data.name = "Renamed meanwhile"
    proxies = [bone for bone in ready.data.objects["Rig"].pose.bones if bone.name.startswith("Skirt_proxy")]
    turns = {}
    for frame in (40, 55, 1, -3):
        ready.context.scene.frame_set(frame)
        turns[frame] = np.array([bone.rotation_quaternion for bone in proxies])
    np.testing.assert_array_equal(turns[55], turns[40])
    np.testing.assert_array_equal(turns[-3], turns[1])


def test_edits_are_followed_from_where_they_begin(ready, trained):
    """What was read is found to be old, frames before stay, and reading again gives what playing on has given.

    At the model's rate: at others a frame lies between steps, of which the later one looks ahead.
    """
    ready.context.scene.render.fps = 30
    ready.ops.ssilk.play_live()
    before = shown(ready, trained, FRAMES)
    spine = ready.data.objects["Rig"].pose.bones["Spine"]
    spine.rotation_quaternion = (1, 0.5, 0.3, 0)
    spine.keyframe_insert("rotation_quaternion", frame=33)
    shown(ready, trained, [10])  # Blender tells of the edit
    live = playing().live(trained)
    after = shown(ready, trained, FRAMES)
    assert live.stale
    np.testing.assert_array_equal(after[:24], before[:24])  # where the curves are as they were
    assert np.abs(after[32:] - before[32:]).max() > 1e-3
    assert ready.ops.ssilk.refresh_live() == {"FINISHED"}
    assert not live.stale
    again = shown(ready, trained, reversed(FRAMES))[::-1]
    np.testing.assert_allclose(after, again, atol=1e-6)


def test_saved_files_go_on_playing_and_handlers_stay_until_disabled(ready, trained, wanted, folder):
    import addon_utils

    ready.ops.ssilk.play_live()
    ready.ops.wm.save_as_mainfile(filepath=str(folder / "again.blend"), copy=True)
    ready.ops.wm.read_homefile(use_empty=True)
    assert not playing()._played
    ready.ops.wm.open_mainfile(filepath=str(folder / "again.blend"))
    garment = ready.data.objects["Skirt"]
    assert playing().live(garment), playing().reason(garment)
    assert np.abs(shown(ready, garment, [25])[0] - wanted[24]).max() < EXACT
    addon_utils.disable("blender_addon", default_set=True)
    left = [
        function
        for name in dir(ready.app.handlers)
        if isinstance(handlers := getattr(ready.app.handlers, name), list)
        for function in handlers
        if function.__module__.startswith("blender_addon")
    ]
    assert not left and addon_utils.enable("blender_addon", default_set=True)


def test_stopped_garments_stay_and_deleted_ones_are_let_go(ready, trained):
    ready.ops.ssilk.play_live()
    ready.context.scene.frame_set(20)
    ready.ops.ssilk.stop_live()
    bone = next(bone for bone in ready.data.objects["Rig"].pose.bones if bone.name.startswith("Skirt_proxy"))
    held = tuple(bone.rotation_quaternion)
    ready.context.scene.frame_set(30)
    assert tuple(bone.rotation_quaternion) == held
    ready.ops.ssilk.play_live()
    ready.data.objects.remove(ready.data.objects["Rig"])
    ready.context.scene.frame_set(10)
    assert playing().live(trained) is None and "deleted" in playing().reason(trained)


def test_what_cannot_be_played_is_said(ready, trained, tmp_path):
    with pytest.raises(RuntimeError, match="is not played"):
        ready.ops.ssilk.stop_live()
    trained.ssilk.model = str(tmp_path / "none.safetensors")
    with pytest.raises(RuntimeError, match="has no model at"):
        ready.ops.ssilk.play_live()
    (tmp_path / "none.safetensors").write_bytes(b"nothing")
    with pytest.raises(RuntimeError, match="not a safetensors file"):
        ready.ops.ssilk.play_live()
    trained.ssilk.model = ""
    ready.context.view_layer.objects.active = ready.data.objects["Rig"]
    ready.ops.object.mode_set(mode="EDIT")
    ready.data.objects["Rig"].data.edit_bones["Head"].name = "Kopf"
    ready.data.objects["Rig"].data.edit_bones["Kopf"].roll += 0.5  # nor is it in the place that the training knows
    ready.ops.object.mode_set(mode="OBJECT")
    activate(ready, trained)
    with pytest.raises(RuntimeError, match="not those that the garment was trained with"):
        ready.ops.ssilk.play_live()


def test_shapes_that_an_undo_takes_away_come_back(ready, trained):
    """Blender shows a frame before it tells that something was undone."""
    from blender_addon.playback import playing
    from blender_addon.scene.meshes import remove_shapes

    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    before = shown(ready, trained, FRAMES)
    remove_shapes(trained)
    ready.context.scene.frame_set(7)
    assert playing.live(trained) and not playing.reason(trained)
    np.testing.assert_allclose(shown(ready, trained, FRAMES), before, atol=1e-6)
