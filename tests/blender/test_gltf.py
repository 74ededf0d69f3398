# SPDX-License-Identifier: Apache-2.0
"""Export glTF: what Blender's exporter writes of a bake is what Blender shows; by its defaults it is not."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from blender_addon.operators.gltf_export import proposed
from blender_addon.playback import gltf
from blender_addon.playback.gltf import SETTINGS, largest_loss
from ssilk_core.delivery.gltf.file import GlbFile
from ssilk_core.delivery.gltf.skinned import SkinnedGlb
from ssilk_core.errors import SsilkError

from .conftest import activate
from .scenes import shown

FRAMES = range(1, 13)


@pytest.fixture
def baked(ready, trained):
    """The skirt with a short bake that moves it visibly, on a rig that hangs on a scaled and moving object."""
    scene, rig = ready.context.scene, ready.data.objects["Rig"]
    scene.frame_end = FRAMES.stop - 1
    assert ready.ops.ssilk.bake(pre_roll=0.0) == {"FINISHED"}
    trained.parent = rig
    top = ready.data.objects.new("Top", None)
    scene.collection.objects.link(top)
    rig.parent, top.scale = top, (2.0, 2.0, 2.0)
    for frame in (1, 12):
        top.location, top.rotation_euler = (frame / 8, 1.0, 0.5), (0.2, 0.0, frame / 30)
        top.keyframe_insert("location", frame=frame)
        top.keyframe_insert("rotation_euler", frame=frame)
    ready.context.view_layer.update()
    return trained


def test_a_glb_shows_what_blender_shows(ready, baked, tmp_path):
    activate(ready, ready.data.objects["Pillar"])
    selected = ready.data.objects["Pillar"]
    ready.context.view_layer.objects.active = baked
    before = shown(ready, baked, FRAMES)
    path = tmp_path / "Skirt.glb"
    assert ready.ops.ssilk.export_gltf(filepath=str(path)) == {"FINISHED"}
    assert ready.context.selected_objects == [selected] and [file.name for file in tmp_path.iterdir()] == [path.name]
    loss, frame = largest_loss(baked, path)
    assert loss < 5e-4 and frame in FRAMES
    document = GlbFile(path).document
    assert len(document["animations"]) == 1 and len(document["meshes"]) == 2
    np.testing.assert_array_equal(shown(ready, baked, FRAMES), before)
    # The comparison sees what is lost: with four influences, and with an animation for each action.
    few = {**SETTINGS, "export_all_influences": False, "use_selection": False}
    ready.ops.export_scene.gltf(filepath=str(path), **few)
    assert largest_loss(baked, path)[0] > 5e-3
    ready.ops.export_scene.gltf(filepath=str(path), **{**few, "export_animation_mode": "ACTIONS"})
    with pytest.raises(SsilkError, match=r"1 skinned nodes 'Skirt' and [2-9] animations"):
        largest_loss(baked, path)


def test_a_file_is_proposed_before_and_after_the_scene_is_saved(bpy, skirt, tmp_path):
    assert proposed(skirt) == Path("Skirt.glb")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    assert proposed(skirt) == tmp_path / "Skirt.glb"


def test_what_is_hidden_is_shown_while_it_is_exported(ready, baked, tmp_path):
    scene, rig, path = ready.context.scene, ready.data.objects["Rig"], tmp_path / "Skirt.glb"
    baked.hide_set(True)
    rig.hide_set(True)
    rig.hide_viewport = True
    assert ready.ops.ssilk.export_gltf(filepath=str(path)) == {"FINISHED"}
    assert (baked.hide_get(), baked.hide_viewport, rig.hide_get(), rig.hide_viewport) == (True, False, True, True)
    baked.hide_set(False)
    assert largest_loss(baked, path)[0] < 5e-4
    closet = ready.data.collections.new("Closet")
    scene.collection.children.link(closet)
    closet.objects.link(rig)
    scene.collection.objects.unlink(rig)
    layer = ready.context.view_layer.layer_collection.children["Closet"]
    for hide in ("hide_viewport", "exclude"):
        setattr(layer, hide, True)
        with pytest.raises(RuntimeError, match="'Rig' is in a hidden collection; show that in the outliner"):
            ready.ops.ssilk.export_gltf(filepath=str(path))
        setattr(layer, hide, False)


def test_python_drivers_play_as_in_the_session_or_nothing_is_written(ready, baked, tmp_path):
    """A driver that the file brings runs wherever it runs here; a function that this Blender alone has does not."""
    path = tmp_path / "Skirt.glb"
    driver = ready.data.objects["Rig"].driver_add("location", 0).driver
    driver.expression = "[frame / 10].pop()"
    ready.ops.wm.save_as_mainfile(filepath=str(tmp_path / "driven.blend"))
    for trusted in (False, True):
        ready.ops.wm.open_mainfile(filepath=str(tmp_path / "driven.blend"), use_scripts=trusted)
        garment, rig = (ready.data.objects[name] for name in ("Skirt", "Rig"))
        ready.context.scene.frame_set(12)
        assert rig.location.x == pytest.approx(1.2 * trusted)
        assert ready.ops.ssilk.export_gltf(filepath=str(path)) == {"FINISHED"}
        assert largest_loss(garment, path)[0] < 5e-4
    path.unlink()
    ready.app.driver_namespace["ours"] = lambda frame: frame / 10
    rig.animation_data.drivers[0].driver.expression = "ours(frame)"
    with pytest.raises(RuntimeError, match=r"'Skirt' is 2\.?\d*e\+03 mm elsewhere in the Blender that exports it"):
        ready.ops.ssilk.export_gltf(filepath=str(path))
    assert not path.exists() and len(ready.data.scenes) == 1


@pytest.mark.parametrize("divides", [False, True])
def test_a_glb_plays_at_a_rate_that_is_no_integer(ready, baked, tmp_path, monkeypatch, divides):
    render, path = ready.context.scene.render, tmp_path / "Skirt.glb"
    render.fps, render.fps_base = 24, 1.001
    before = render.fps_base
    if divides:  # as an exporter would that has been mended
        export = gltf._export

        def mended(path):
            with gltf._fps_base(1 / render.fps_base):
                export(path)

        monkeypatch.setattr(gltf, "_export", mended)
    gltf.exported(baked, ready.data.objects["Rig"], path)
    assert render.fps_base == before
    played = SkinnedGlb(path, "Skirt")
    assert (played.start, played.end) == pytest.approx((1.001 / 24, 12 * 1.001 / 24), rel=1e-6)


def test_what_a_glb_cannot_hold_is_refused_and_leaves_no_file(ready, baked, tmp_path):
    path = tmp_path / "Skirt.glb"
    with pytest.raises(RuntimeError, match=r"'Skirt.usd' is no name for a glTF binary; it ends in .glb"):
        ready.ops.ssilk.export_gltf(filepath=str(tmp_path / "Skirt.usd"))
    wave = baked.modifiers.new("Wave", "WAVE")
    wave.height, wave.speed = 0.2, 0.5
    with pytest.raises(RuntimeError) as error:
        ready.ops.ssilk.export_gltf(filepath=str(path))
    assert re.search(r"'Skirt' would be \S+ mm off .* in frame \d+; what modifiers do .* 'Wave'", str(error.value))
    assert not list(tmp_path.iterdir())
    baked.modifiers.remove(wave)
    ready.context.scene.frame_end = ready.context.scene.frame_start
    with pytest.raises(RuntimeError, match="The scene has one frame, and an animation needs two"):
        ready.ops.ssilk.export_gltf(filepath=str(path))
    ready.context.scene.frame_end = FRAMES.stop - 1
    assert ready.ops.ssilk.export_gltf.poll()
    assert ready.ops.ssilk.remove_bake() == {"FINISHED"}
    assert not ready.ops.ssilk.export_gltf.poll()


def test_an_export_tells_how_far_it_is_and_can_be_cancelled(ready, baked, tmp_path, monkeypatch, capfd):
    from blender_addon.operators import tasks
    from blender_addon.outside.work import Work

    heard, poll = [], Work.poll

    def polled(work) -> bool:
        ended = poll(work)
        if work.fraction is not None and not work.cancelled:
            heard.append(work.fraction)
            work.cancel()
        return ended

    monkeypatch.setattr(Work, "poll", polled)
    assert ready.ops.ssilk.export_gltf(filepath=str(tmp_path / "Skirt.glb")) == {"CANCELLED"}
    assert "Exporting 'Skirt' was cancelled" in capfd.readouterr().out
    assert 0 < heard[0] < 1 and tasks.current is None
    assert not list(tmp_path.iterdir())
