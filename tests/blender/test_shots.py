# SPDX-License-Identifier: Apache-2.0
"""Shots that link a character with its trained garment, override both, and own neither."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from .conftest import activate
from .scenes import animate, proxies_of, shown

EXACT = 1e-5  # [m]
FRAMES = range(1, 41)
THINGS = ("Rig", "Pillar", "Skirt")


def move(bpy, armature) -> None:
    """Animate an armature as the shot does, its bones and its object."""
    animate(bpy, armature, "Shot", 0.45, 40)
    for frame, place in ((1, (0.0, 0.0, 0.0)), (20, (0.6, -0.3, 0.1)), (40, (0.2, 0.5, 0.0))):
        armature.location = place
        armature.keyframe_insert("location", frame=frame)
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = 1, 40


@pytest.fixture(scope="module")
def local(folder) -> dict[str, np.ndarray]:
    """What a bake in the file that owns everything shows; filled by the first test that asks."""
    return {}


@pytest.fixture
def shot(ready, trained, folder, local, tmp_path):
    """The overridden skirt in a file that links its character and animates it."""
    asset = folder / "asset.blend"
    if not local:
        group = ready.data.collections.new("Character")
        ready.context.scene.collection.children.link(group)
        for name in THINGS:
            group.objects.link(ready.data.objects[name])
            ready.context.scene.collection.objects.unlink(ready.data.objects[name])
        trained.parent = ready.data.objects["Rig"]
        ready.ops.wm.save_as_mainfile(filepath=str(asset))
        move(ready, ready.data.objects["Rig"])
        activate(ready, trained)
        assert ready.ops.ssilk.bake() == {"FINISHED"}
        local["baked"] = shown(ready, trained, FRAMES)
        ready.ops.wm.save_as_mainfile(filepath=str(folder / "baked asset.blend"))
    return linked(ready, asset, tmp_path / "shots" / "shot.blend")


def linked(bpy, asset: Path, path: Path):
    """Return the overridden skirt of a new file that links the character of an asset."""
    path.parent.mkdir(exist_ok=True)
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    with bpy.data.libraries.load(str(asset), link=True, relative=True) as (_, wanted):
        wanted.collections = ["Character"]
    (group,) = wanted.collections
    group.override_hierarchy_create(bpy.context.scene, bpy.context.view_layer, do_fully_editable=True)
    return dressed(bpy)


def dressed(bpy):
    """Return the overridden skirt, active, of an armature that moves."""
    here = {thing.override_library.reference.name: thing for thing in bpy.data.objects if thing.override_library}
    if here["Rig"].animation_data is None or here["Rig"].animation_data.action.name.partition(".")[0] != "Shot":
        move(bpy, here["Rig"])
    activate(bpy, here["Skirt"])
    return here["Skirt"]


def files_in(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_a_shot_bakes_what_the_file_that_owns_the_character_bakes(ready, shot, local, folder):
    owned = files_in(folder)
    mesh = shot.data
    assert mesh.library
    assert ready.ops.ssilk.bake() == {"FINISHED"}
    assert np.abs(shown(ready, shot, FRAMES) - local["baked"]).max() < EXACT
    ready.ops.wm.save_mainfile()
    ready.ops.wm.open_mainfile(filepath=ready.data.filepath)
    again = dressed(ready)
    assert np.abs(shown(ready, again, FRAMES) - local["baked"]).max() < EXACT
    assert again.override_library and again.data.library is None
    assert files_in(folder) == owned
    assert ready.ops.ssilk.remove_bake() == {"FINISHED"}
    assert again.data.library and not ready.data.shape_keys
    assert not [track for track in ready.data.objects["Rig"].animation_data.nla_tracks if "SSILK" in track.name]
    ready.context.view_layer.update()
    assert np.abs(shown(ready, again, FRAMES) - local["baked"]).max() > 0.05


def test_a_shot_plays_live_and_does_so_when_it_is_opened_again(ready, shot, local):
    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    assert np.abs(shown(ready, shot, FRAMES) - local["baked"]).max() < EXACT
    ready.ops.wm.save_mainfile()
    ready.ops.wm.open_mainfile(filepath=ready.data.filepath)
    again = dressed(ready)
    from blender_addon.playback import playing

    assert playing.live(again)
    assert not [thing for thing in ready.data.objects if thing.library and playing.live(thing)]
    assert np.abs(shown(ready, again, FRAMES) - local["baked"]).max() < EXACT
    assert ready.ops.ssilk.stop_live() == {"FINISHED"}
    assert ready.ops.ssilk.remove_bake() == {"FINISHED"}
    assert again.data.library


def test_two_of_one_character_are_baked_apart(ready, shot, local, folder):
    first, second = shot, linked_again(ready)
    second.parent.location = (3, 0, 0)
    for garment in (first, second):
        activate(ready, garment)
        assert ready.ops.ssilk.bake() == {"FINISHED"}
    assert first.data != second.data
    assert np.abs(shown(ready, first, FRAMES) - local["baked"]).max() < EXACT
    held = shown(ready, second, range(1, 2))[0]
    assert abs(held[:, 0].mean() - 3) < 0.3


def linked_again(bpy):
    """Return the skirt of a second override of the character, which stands still."""
    before = set(bpy.data.objects)
    (group,) = (group for group in bpy.data.collections if group.library and group.name == "Character")
    group.override_hierarchy_create(bpy.context.scene, bpy.context.view_layer, do_fully_editable=True)
    return next(thing for thing in set(bpy.data.objects) - before if thing.type == "MESH" and "Skirt" in thing.name)


def test_a_bake_of_the_asset_is_set_aside_in_the_shot(ready, shot, local, folder, tmp_path):
    garment = linked(ready, folder / "baked asset.blend", tmp_path / "shots" / "second.blend")
    armature = garment.parent
    inherited = [track for track in armature.animation_data.nla_tracks if track.is_override_data]
    assert [track.name for track in inherited] == ["SSILK Skirt"]
    armature.pose.bones["Spine"].rotation_quaternion = (0.9, 0.4, 0, 0)
    armature.animation_data.action = None
    assert ready.ops.ssilk.bake() == {"FINISHED"}
    assert inherited[0].mute
    assert np.abs(shown(ready, garment, FRAMES) - local["baked"]).max() > 0.05
    assert ready.ops.ssilk.remove_bake() == {"FINISHED"}
    assert not inherited[0].mute and garment.data.library


def test_proxies_are_put_away_in_a_shot_too(ready, shot):
    assert ready.ops.ssilk.bake() == {"FINISHED"}
    proxies = [shot.parent.pose.bones[name] for name in proxies_of(ready)]
    assert proxies and all(all(bone.lock_location) and getattr(bone, "hide", True) for bone in proxies)
    assert ready.ops.ssilk.remove_bake() == {"FINISHED"}
    assert not any(any(bone.lock_location) or getattr(bone, "hide", False) for bone in proxies)


def test_a_model_that_the_asset_chose_is_found_from_the_shot(ready, trained, folder, tmp_path):
    from blender_addon.playback.models import model_of

    chosen = folder / "chosen.safetensors"
    shutil.copy(model_of(trained), chosen)
    trained.ssilk.model = "//chosen.safetensors"
    group = ready.data.collections.new("Character")
    ready.context.scene.collection.children.link(group)
    for name in THINGS:
        group.objects.link(ready.data.objects[name])
    trained.parent = ready.data.objects["Rig"]
    ready.ops.wm.save_as_mainfile(filepath=str(folder / "choosing.blend"))
    garment = linked(ready, folder / "choosing.blend", tmp_path / "shots" / "third.blend")
    assert model_of(garment) == chosen
    (tmp_path / "elsewhere").mkdir()
    ready.ops.wm.save_as_mainfile(filepath=str(tmp_path / "elsewhere" / "third.blend"))
    assert model_of(garment) == chosen
    own = shutil.copy(chosen, tmp_path / "elsewhere" / "own.safetensors")
    garment.ssilk.model = "//own.safetensors"
    assert model_of(garment) == Path(own)
    ready.ops.wm.save_mainfile()
    ready.ops.wm.open_mainfile(filepath=ready.data.filepath)
    assert model_of(dressed(ready)) == Path(own)


def test_usd_lies_beside_the_shot(ready, shot, folder):
    owned = files_in(folder)
    assert ready.ops.ssilk.bake(to_timeline=False, to_usd=True) == {"FINISHED"}
    assert Path(ready.data.filepath).with_name("Skirt.usdc").exists()
    assert files_in(folder) == owned and shot.data.library


def test_heat_colours_a_mesh_of_the_shot(ready, shot):
    assert ready.ops.ssilk.show_heat(kind="STRETCH") == {"FINISHED"}
    assert shot.data.library is None and "SSILK Heat" in shot.data.color_attributes
    with pytest.raises(RuntimeError, match=r"The mesh of 'Pillar' belongs to 'asset\.blend'"):
        ready.ops.ssilk.show_heat(kind="SKIN")


def test_linear_blend_skinning_is_shown_beside(ready, shot):
    assert ready.ops.ssilk.toggle_lbs() == {"FINISHED"}
    assert ready.ops.ssilk.toggle_lbs() == {"FINISHED"}


def test_what_a_shot_cannot_change_says_where_it_can(ready, shot):
    for change in (ready.ops.ssilk.generate_rig, ready.ops.ssilk.classify, ready.ops.ssilk.train):
        with pytest.raises(RuntimeError, match=r"'Skirt' belongs to 'asset\.blend'; open that file to change it"):
            change()


def test_what_is_linked_only_says_how_to_override_it(ready, shot):
    bpy, group = ready, next(group for group in ready.data.collections if group.library)
    bpy.context.scene.collection.children.link(group)
    bpy.context.view_layer.objects.active = next(thing for thing in group.objects if thing.name == "Skirt")
    with pytest.raises(RuntimeError, match=r"'Skirt' is linked from 'asset\.blend'; override it \(Object > Library"):
        bpy.ops.ssilk.play_live()
    instance = bpy.data.objects.new("Hero", None)
    instance.instance_type, instance.instance_collection = "COLLECTION", group
    bpy.context.scene.collection.objects.link(instance)
    activate(bpy, instance)
    with pytest.raises(RuntimeError, match=r"'Hero' is linked from 'asset\.blend'; override it .*select the garment"):
        bpy.ops.ssilk.play_live()


def test_panels_show_what_can_be_done_in_a_shot(ready, shot):
    from blender_addon.panels.classes import ClassesPanel
    from blender_addon.panels.playback import BakingPanel, PlaybackPanel

    assert BakingPanel.poll(ready.context) and PlaybackPanel.poll(ready.context)
    assert not ClassesPanel.poll(ready.context)


@pytest.mark.parametrize("how", ["play_live", "bake"])
def test_farms_show_a_shot_without_the_extension(ready, shot, local, how):
    """The keys stand in the file: a render reads them, and no handler need run."""
    import addon_utils

    assert getattr(ready.ops.ssilk, how)() == {"FINISHED"}
    ready.ops.wm.save_mainfile()
    addon_utils.disable("blender_addon", default_set=True)
    ready.ops.wm.open_mainfile(filepath=ready.data.filepath)
    assert np.abs(shown(ready, dressed(ready), FRAMES) - local["baked"]).max() < EXACT
