# SPDX-License-Identifier: Apache-2.0
"""Baking: what Blender shows is what the decoder says, and what the artist made stays."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from blender_addon.playback.models import model_of

from .conftest import activate, add_mesh, tube
from .scenes import decoded, proxies_of, shown
from .test_shapes import fuller, keyed

EXACT = 1e-5  # [m]
FRAMES = range(1, 41)


def a_driver_of_its_bone(pillar) -> None:
    """A corrective, as riggers make them."""
    driver = fuller(pillar).driver_add("value").driver
    driver.type = "AVERAGE"
    variable = driver.variables.new()
    variable.type = "TRANSFORMS"
    variable.targets[0].id, variable.targets[0].bone_target = pillar.find_armature(), "Head"
    variable.targets[0].transform_type, variable.targets[0].transform_space = "LOC_Z", "WORLD_SPACE"


def a_masked_key(pillar) -> None:
    """A key that shapes a part of the body, and that begins to weigh less than none, over another that is still."""
    fuller(pillar, 0.3, name="Still", amount=0.1)
    pillar.vertex_groups.new(name="Mask").add(list(range(0, len(pillar.data.vertices), 2)), 0.5, "REPLACE")
    key = fuller(pillar)
    key.vertex_group = "Mask"
    for frame, key.value in ((1, -0.5), (6, 1.5)):
        key.keyframe_insert("value", frame=frame)


def bake(bpy, garment, **options) -> None:
    activate(bpy, garment)
    assert bpy.ops.ssilk.bake(**options) == {"FINISHED"}


def refused(bpy, garment, **options) -> str:
    activate(bpy, garment)
    with pytest.raises(RuntimeError) as error:
        bpy.ops.ssilk.bake(**options)
    return str(error.value)


def strips(thing, garment) -> list:
    from blender_addon.motions.keys import is_baked

    tracks = thing.animation_data.nla_tracks if thing.animation_data else ()
    return [strip for track in tracks for strip in track.strips if is_baked(strip.action, garment)]


@pytest.mark.parametrize("pre_roll", [0.0, 1.0])
def test_blender_shows_what_the_decoder_says_on_every_frame(ready, trained, tmp_path, ssilk_python, pre_roll):
    bake(ready, trained, pre_roll=pre_roll)
    wanted = decoded(ssilk_python, model_of(trained), tmp_path, pre_roll=pre_roll)
    plain = decoded(ssilk_python, model_of(trained), tmp_path, lbs=True)
    assert np.abs(wanted - plain).max() > 0.05
    assert np.abs(shown(ready, trained, FRAMES) - wanted).max() < EXACT


def test_a_level_of_quality_leaves_shapes_out(ready, trained, tmp_path, ssilk_python):
    bake(ready, trained)
    whole = shown(ready, trained, FRAMES)
    bake(ready, trained, quality="crowd")
    away = np.linalg.norm(shown(ready, trained, FRAMES) - whole, axis=-1).max()
    plain = decoded(ssilk_python, model_of(trained), tmp_path, lbs=True)
    assert 1e-4 < away < np.linalg.norm(whole - plain, axis=-1).max()
    assert len([key for key in trained.data.shape_keys.key_blocks if key.name.startswith("SSILK ")]) < 25


def test_hero_is_put_back_onto_bones_and_shape_keys(ready, trained, monkeypatch):
    """It differs from the whole model, has shapes of its own, and the report says how near they are."""
    from blender_addon.operators import baking

    told, lost = [], baking.lost
    monkeypatch.setattr(baking, "lost", lambda figures: told.append(lost(figures)) or told[-1])
    ready.context.scene.frame_end = 6
    bake(ready, trained)
    whole = shown(ready, trained, range(1, 7))
    bake(ready, trained, quality="hero")
    assert np.abs(shown(ready, trained, range(1, 7)) - whole).max() > 1e-3
    assert told[0] == ""
    found = re.search(r"(\d+) shape keys are within (\S+) mm \(RMS\), (\S+) mm at most", told[1])
    assert found and 0 < float(found[2]) <= 1 and float(found[2]) < float(found[3]) <= 5
    keys = [key for key in trained.data.shape_keys.key_blocks if key.name.startswith("SSILK ")]
    assert len(keys) == int(found[1])


def test_a_reduced_model_leaves_its_proxies_at_rest(ready, trained, tmp_path, ssilk_python):
    few = model_of(trained).with_name("few.safetensors")
    words = ["-m", "ssilk_core", "reduce", str(model_of(trained)), "--joints", "3", "-o", str(few)]
    subprocess.run([ssilk_python, *words], check=True, cwd=few.parent)
    trained.ssilk.model = str(few)
    bake(ready, trained)
    wanted = decoded(ssilk_python, few, tmp_path, pre_roll=1.0)
    assert np.abs(shown(ready, trained, FRAMES) - wanted).max() < EXACT
    assert len([group for group in trained.vertex_groups if group.name.startswith("Skirt_proxy")]) == 3


def test_levels_are_those_of_ssilk(bpy):
    from blender_addon.operators.baking import QUALITY_ITEMS
    from blender_addon.settings.training import CHOICES
    from ssilk_core.quality.levels import QUALITIES
    from ssilk_core.training.settings import PRESETS

    assert [name for name, *_ in CHOICES] == list(PRESETS)
    assert [name for name, *_ in QUALITY_ITEMS] == ["WHOLE", *QUALITIES]


def test_the_bake_is_one_action_beneath_the_artists_own(ready, trained):
    from blender_addon.motions.keys import SLOTS, curves_of, is_baked

    bake(ready, trained)
    armature, keys = ready.data.objects["Rig"], trained.data.shape_keys
    assert armature.animation_data.action.name == "Walk"
    (bones,), (shapes,) = strips(armature, trained), strips(keys, trained)
    assert (bones.frame_start, bones.frame_end) == (1, 40)
    if SLOTS:
        assert bones.action == shapes.action
        assert (bones.action_slot.target_id_type, shapes.action_slot.target_id_type) == ("OBJECT", "KEY")
    for action in filter(is_baked, ready.data.actions):
        for curve in curves_of(action):
            assert {point.interpolation for point in curve.keyframe_points} == {"LINEAR"}
            assert [point.co.x for point in curve.keyframe_points] == list(FRAMES)
    proxies = [bone for bone in armature.pose.bones if bone.name.startswith("Skirt_proxy")]
    assert len(proxies) == 6
    assert all(bone.rotation_mode == "QUATERNION" for bone in proxies)


def follow(bpy, armature, garment) -> None:
    """Animate the armature as an object, far from where it was trained."""
    for frame in (1, 40):
        armature.location, armature.rotation_euler = (frame / 8, 3.0, 1.0), (0.3, 0.0, frame / 30)
        armature.keyframe_insert("location", frame=frame)
        armature.keyframe_insert("rotation_euler", frame=frame)


def test_the_armature_may_move_as_an_object_with_the_garment(ready, trained, tmp_path, ssilk_python):
    armature = ready.data.objects["Rig"]
    trained.parent = armature
    follow(ready, armature, trained)
    ready.context.scene.frame_set(17)
    bake(ready, trained)
    wanted = decoded(ssilk_python, model_of(trained), tmp_path, pre_roll=1.0)
    assert np.ptp(wanted[:, 0, 0]) > 4
    away = np.abs(shown(ready, trained, FRAMES) - wanted).max()
    assert away < EXACT


def test_a_garment_that_is_left_behind_is_named(ready, trained):
    follow(ready, ready.data.objects["Rig"], trained)
    assert "leaves 'Skirt' behind" in refused(ready, trained)


def test_baking_again_replaces_only_what_was_baked(ready, trained):
    bake(ready, trained)
    armature = ready.data.objects["Rig"]
    fix = trained.shape_key_add(name="Fix", from_mix=False)
    fix.data[0].co.x += 0.25
    fix.value = 1.0
    proxy = armature.pose.bones["Skirt_proxy_03"]
    proxy.constraints.new("LIMIT_ROTATION")
    walk = armature.animation_data.action
    proxy.keyframe_insert("location", frame=1)
    own = armature.animation_data.nla_tracks.new()
    own.strips.new("Spin", 100, ready.data.actions["Spin Ö"])
    before = {action.name for action in ready.data.actions}
    first = shown(ready, trained, FRAMES)
    bake(ready, trained)
    assert {action.name for action in ready.data.actions} == before
    playing = [track.strips[0].action.name for track in armature.animation_data.nla_tracks]
    assert playing == ["SSILK Skirt", "Spin Ö"]
    assert armature.animation_data.action == walk
    assert len(proxy.constraints) == 1
    assert trained.data.shape_keys.key_blocks["Fix"].value == 1.0
    assert len([key for key in trained.data.shape_keys.key_blocks if key.name.startswith("SSILK ")]) == 25
    np.testing.assert_allclose(shown(ready, trained, FRAMES), first, atol=EXACT)
    assert ready.ops.ssilk.remove_bake() == {"FINISHED"}
    assert [key.name for key in trained.data.shape_keys.key_blocks] == ["Basis", "Fix"]
    assert not strips(armature, trained)
    assert not ready.ops.ssilk.remove_bake.poll()


def under_an_empty(bpy, garment, armature):
    """Hang both on an empty, as importers do, and let that run, turn and rise over the frames; return it."""
    empty = bpy.data.objects.new("Character", None)
    bpy.context.collection.objects.link(empty)
    garment.parent = armature.parent = empty
    for frame, place, turn in ((1, (0, 0, 0), 0.0), (15, (1.5, 0.4, 0.2), 0.8), (40, (4.0, -1.0, 0.0), 2.5)):
        empty.location, empty.rotation_euler = place, (0, 0, turn)
        empty.keyframe_insert("location", frame=frame)
        empty.keyframe_insert("rotation_euler", frame=frame)
    bpy.context.scene.frame_set(7)  # away from where it was trained
    return empty


@pytest.mark.parametrize("live", [False, True])
def test_an_empty_above_character_and_garment_moves_both_and_the_cloth_feels_it(
    ready, trained, tmp_path, ssilk_python, live
):
    bake(ready, trained)
    in_place = shown(ready, trained, FRAMES)
    empty = under_an_empty(ready, trained, ready.data.objects["Rig"])
    bake(ready, trained)
    wanted = decoded(ssilk_python, model_of(trained), tmp_path, pre_roll=1.0)
    if live:
        assert ready.ops.ssilk.remove_bake() == {"FINISHED"}
        assert ready.ops.ssilk.play_live() == {"FINISHED"}
    found = shown(ready, trained, FRAMES)
    assert np.abs(found - wanted).max() < (1e-4 if live else EXACT)
    carried = []
    for frame, points in zip(FRAMES, in_place):
        ready.context.scene.frame_set(frame)
        world = np.array(empty.matrix_world)
        carried.append(points @ world[:3, :3].T + world[:3, 3])
    assert np.abs(found - carried).max() > 1e-4  # inertia and air, of which this model knows little


def test_what_moves_without_the_garment_beneath_that_empty_is_told(ready, trained):
    under_an_empty(ready, trained, ready.data.objects["Rig"])
    armature = ready.data.objects["Rig"]
    armature.location.x = 1.0
    armature.keyframe_insert("location", frame=1)
    armature.location.x = 2.0
    armature.keyframe_insert("location", frame=30)
    assert "leaves 'Skirt' behind; make it the parent, or let one object above both move them" in refused(
        ready, trained
    )


def test_removing_a_bake_leaves_the_garment_as_it_was(ready, trained):
    from blender_addon.scene.weights import read_groups

    def state() -> tuple:
        names = [group.name for group in trained.vertex_groups]
        return (
            names,
            read_groups(trained, trained.data, sorted(names)).tolist(),
            sorted(trained.data.attributes.keys()),
        )

    before = state()
    bake(ready, trained)
    assert state() != before
    assert ready.ops.ssilk.remove_bake() == {"FINISHED"}
    assert sorted(state()[0]) == sorted(before[0]) and state()[1:] == before[1:]
    assert not trained.data.shape_keys
    trained.shape_key_add(name="Basis")
    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    assert ready.ops.ssilk.remove_bake() == {"FINISHED"}
    assert not trained.ssilk.live and state()[1:] == before[1:]
    assert [key.name for key in trained.data.shape_keys.key_blocks] == ["Basis"]


def test_garments_of_one_armature_are_baked_apart(bpy, skirt):
    from blender_addon.motions.keys import Channel, bake_keys, has_keys, remove_keys

    armature, apron = bpy.data.objects["Rig"], bpy.data.objects.new("Apron", skirt.data.copy())

    def turn(bone: str, value: float) -> list[Channel]:
        return [Channel(f'pose.bones["{bone}"].location', 0, bone, np.full(5, value))]

    def places(frame: int) -> list[float]:
        bpy.context.scene.frame_set(frame)
        return [armature.pose.bones[bone].location.x for bone in ("Hips", "Spine")]

    bake_keys(skirt, 3, [(armature, turn("Hips", 1.0))])
    bake_keys(apron, 3, [(armature, turn("Spine", 2.0))])
    assert places(5) == [1.0, 2.0]
    bake_keys(skirt, 3, [(armature, turn("Hips", 4.0))])
    assert places(5) == [4.0, 2.0]
    remove_keys(skirt, [armature])
    assert [len(strips(armature, thing)) for thing in (skirt, apron)] == [0, 1]
    bake_keys(apron, 3, [(armature, [])])
    assert not armature.animation_data.nla_tracks
    assert not has_keys(apron)


def test_keys_of_the_artist_win_over_baked_ones(ready, trained):
    bake(ready, trained)
    armature = ready.data.objects["Rig"]
    proxy = armature.pose.bones["Skirt_proxy_03"]
    proxy.rotation_quaternion = (0.8, 0.6, 0, 0)
    proxy.keyframe_insert("rotation_quaternion", frame=5)
    ready.context.scene.frame_set(30)
    found = np.array(
        armature.evaluated_get(ready.context.evaluated_depsgraph_get()).pose.bones[proxy.name].rotation_quaternion
    )
    np.testing.assert_allclose(found, (0.8, 0.6, 0, 0), atol=1e-6)


def test_shapes_go_in_the_objects_own_space(ready, trained, tmp_path, ssilk_python):
    """The garment's object is turned and scaled unequally; its points are where they were."""
    from mathutils import Matrix

    turned = Matrix.LocRotScale((0.2, 0.1, 0.3), Matrix.Rotation(0.7, 3, "X"), (2.0, 0.5, 1.5))
    trained.data.transform(turned.inverted())
    trained.matrix_world = turned
    ready.context.view_layer.update()
    bake(ready, trained)
    wanted = decoded(ssilk_python, model_of(trained), tmp_path, pre_roll=1.0)
    assert np.abs(shown(ready, trained, FRAMES) - wanted).max() < EXACT


def test_usd_lies_beside_the_blend_file(ready, trained, folder, ssilk_python):
    bake(ready, trained, to_timeline=False, to_usd=True)
    assert not strips(ready.data.objects["Rig"], trained)
    shot = folder / "Skirt.usdc"
    assert shot.stat().st_size > 1000
    verified = subprocess.run([ssilk_python, "-m", "ssilk_core", "verify", str(shot)], capture_output=True, text=True)
    assert verified.returncode == 0, verified.stderr
    assert model_of(trained).parent.joinpath("bake", "motion.usdc").exists()


@pytest.mark.parametrize("change", [keyed, a_driver_of_its_bone, a_masked_key])
def test_a_body_whose_shape_keys_change_is_written_as_blender_shows_it(ready, trained, folder, change, capfd):
    from ssilk_usd.shots.play import Shot

    pillar, frames = ready.data.objects["Pillar"], range(1, 7)
    ready.context.scene.frame_end = 6
    change(pillar)
    body = shown(ready, pillar, frames)[..., [0, 2, 1]] * [1, 1, -1]
    bake(ready, trained, to_usd=True)
    told = capfd.readouterr().out
    assert "The network does not see that shape keys of 'Pillar' change; a bake as Hero meets what is seen." in told
    shot = Shot(str(folder / "Skirt.usdc"))
    index = next(index for index, mesh in enumerate(shot.meshes) if mesh.name == "Pillar")
    np.testing.assert_allclose([shot.mesh_points(index, time) for time in shot.frame_times], body, atol=EXACT)


def test_hero_meets_a_body_whose_shape_keys_change(ready, trained, capfd):
    ready.context.scene.frame_end = 4
    bake(ready, trained, quality="hero")
    plain = shown(ready, trained, range(1, 5))
    keyed(ready.data.objects["Pillar"])
    capfd.readouterr()
    bake(ready, trained, quality="hero")
    told = capfd.readouterr().out
    assert "which is not followed" not in told and "does not see" not in told and "off its shape" not in told
    assert np.abs(shown(ready, trained, range(1, 5)) - plain).max() > 5e-3  # it gives way


def test_what_usd_does_not_get_of_a_look_is_named(ready, trained, capfd):
    pillar = ready.data.objects["Pillar"]
    for thing in (trained, pillar):
        thing.data.shade_smooth()
    for name in ("UVMap", "Light"):
        trained.data.uv_layers.new(name=name)
    bake(ready, trained, to_timeline=False, to_usd=True)
    assert "In USD 'Skirt' loses the UV map 'Light'. Bake to the timeline" in capfd.readouterr().out
    for thing, name in ((trained, "Linen"), (trained, "Hem"), (pillar, "Skin")):
        thing.data.materials.append(ready.data.materials.new(name))
    pillar.data.color_attributes.new("Dye", "BYTE_COLOR", "CORNER")
    bake(ready, trained, to_timeline=True, to_usd=False)
    assert "In USD" not in capfd.readouterr().out
    bake(ready, trained, to_timeline=False, to_usd=True)
    assert (
        "In USD 'Skirt' loses the material 'Linen', the material 'Hem', the UV map 'Light'; "
        "'Pillar' loses the material 'Skin', the colours 'Dye'. Bake"
    ) in capfd.readouterr().out


def test_what_a_shot_in_usd_lacks_of_what_blender_shows_is_named(ready, trained, capfd):
    rig, pillar = ready.data.objects["Rig"], ready.data.objects["Pillar"]
    for thing in (trained, pillar):
        thing.data.shade_smooth()
    bake(ready, trained, to_timeline=True, to_usd=False)
    bake(ready, trained, to_timeline=False, to_usd=True)
    assert "in USD" not in capfd.readouterr().out
    eye = add_mesh(ready, "Eye", *tube(8, 3, (1.6, 1.7), (0.05, 0.05)))
    eye.parent, eye.parent_type, eye.parent_bone = rig, "BONE", "Head"
    hair = ready.data.objects.new("Hair", ready.data.hair_curves.new("Hair"))
    ready.context.collection.objects.link(hair)
    hair.parent = pillar
    pillar.parent = rig
    key = fuller(trained, 1.0)
    proxy = rig.pose.bones[proxies_of(ready)[0]]
    proxy.keyframe_insert("location", frame=3)
    ready.context.view_layer.update()
    bake(ready, trained, to_timeline=False, to_usd=True)
    told = capfd.readouterr().out
    assert "The shot in USD holds the garment and its bodies alone, without 'Eye', 'Hair' of 'Rig'." in told
    assert "without what stands over it in Blender: keys of the action" in told
    assert "(shape keys that correct 'Skirt' by up to 100 mm in Blender are not in the shot)" in told
    key.value = 0.0
    bake(ready, trained, to_timeline=False, to_usd=True)
    assert "shape keys that correct" not in capfd.readouterr().out


def test_a_single_frame_is_baked(ready, trained, tmp_path, ssilk_python):
    scene = ready.context.scene
    scene.frame_start = scene.frame_end = 7
    bake(ready, trained, pre_roll=0)
    assert len(strips(ready.data.objects["Rig"], trained)) == 1
    wanted = decoded(ssilk_python, model_of(trained), tmp_path)
    assert wanted.shape[0] == 1
    assert np.abs(shown(ready, trained, range(7, 8)) - wanted).max() < EXACT


def test_frames_before_zero_and_odd_rates_are_baked(ready, trained, tmp_path, ssilk_python):
    scene = ready.context.scene
    scene.frame_start, scene.frame_end = 3, 20
    scene.render.fps, scene.render.fps_base = 24, 1.001
    bake(ready, trained, pre_roll=0)
    wanted = decoded(ssilk_python, model_of(trained), tmp_path)
    assert np.abs(shown(ready, trained, range(3, 21)) - wanted).max() < EXACT


def edit_bone(bpy, armature, name, change) -> None:
    activate(bpy, armature)
    bpy.ops.object.mode_set(mode="EDIT")
    change(armature.data.edit_bones, armature.data.edit_bones[name])
    bpy.ops.object.mode_set(mode="OBJECT")


def test_what_does_not_fit_any_more_is_said(ready, trained):
    armature = ready.data.objects["Rig"]
    edit_bone(ready, armature, "Skirt_proxy_03", lambda bones, bone: bone.translate(armature.location + bone.vector))
    assert "was moved since the garment was trained" in refused(ready, trained)


def test_a_character_that_a_chosen_model_does_not_know_is_called_by_its_name(ready, trained, tmp_path):
    from blender_addon.playback.models import model_of

    trained.ssilk.model = str(shutil.copy(model_of(trained), tmp_path / "chosen.safetensors"))
    edit_bone(ready, ready.data.objects["Rig"], "Head", lambda bones, bone: bone.translate(bone.vector))
    told = refused(ready, trained)
    assert "'Rig': joint 'Head' is bound 0.2 m from where the model has it" in told
    assert ".usdc" not in told


@pytest.mark.parametrize(
    ("harm", "told"),
    [
        (lambda bpy, garment: garment.data.vertices[0].co.__setitem__(0, 5.0), "another shape or place at rest"),
        (lambda bpy, garment: setattr(garment.modifiers[0], "use_deform_preserve_volume", True), "Preserve Volume"),
        (lambda bpy, garment: setattr(garment.modifiers[0], "use_bone_envelopes", True), "Bone Envelopes"),
        (lambda bpy, garment: setattr(bpy.data.armatures["Rig"].bones["Spine"], "bbone_segments", 4), "bends"),
        (lambda bpy, garment: setattr(bpy.data.armatures["Rig"], "pose_position", "REST"), "rest position"),
        (lambda bpy, garment: setattr(bpy.data.objects["Rig"], "hide_viewport", True), "disabled in viewports"),
        (lambda bpy, garment: garment.modifiers.clear(), "no Armature modifier"),
        (lambda bpy, garment: setattr(garment.ssilk, "model", "//no.safetensors"), "has no model at"),
        (lambda bpy, garment: setattr(bpy.data.objects["Rig"].pose.bones["Spine"], "scale", (1, 2, 1)), "is scaled"),
    ],
)
def test_what_cannot_be_baked_is_named(ready, trained, harm, told):
    harm(ready, trained)
    actions = set(ready.data.actions.keys())
    assert told in refused(ready, trained)
    assert set(ready.data.actions.keys()) == actions
    assert not trained.data.shape_keys


def test_classes_that_were_changed_since_the_training_are_told(ready, trained, capfd):
    assert ready.ops.ssilk.bake() == {"FINISHED"}
    assert "as it was trained" not in capfd.readouterr().out
    classes = trained.data.attributes["ssilk:class"].data
    classes[0].value = 2 - classes[0].value
    assert ready.ops.ssilk.bake() == {"FINISHED"}
    assert "as it was trained: classes were changed since" in capfd.readouterr().out


def test_cloth_that_training_loosened_over_other_cloth_was_not_changed_since(bpy, monkeypatch):
    from blender_addon.operators import baking

    skirt = add_mesh(bpy, "Skirt", *tube(6, 3, (0.5, 1.0), (0.1, 0.2)))
    classes = np.arange(len(skirt.data.vertices)) % 3
    skirt.data.attributes.new("ssilk:class", "INT", "POINT").data.foreach_set("value", classes.astype(np.int32))
    loosened = np.where(classes == baking.PINNED, baking.TIGHT, classes)
    for trained, over, note in (
        (loosened, {"inner": "0"}, False),
        (loosened, {}, True),
        (classes[::-1], {"inner": "0"}, True),
    ):
        file = SimpleNamespace(scene=SimpleNamespace(classes=trained), provenance={"over": over})
        monkeypatch.setattr(baking, "load_model", lambda path, file=file: file)
        assert bool(baking.reclassed(skirt, Path("outer.safetensors"))) == note


@pytest.mark.parametrize(
    ("last", "words"),
    [("shows the first one's pose", "last frame"), ("is one before the first", "frame after the last")],
)
def test_a_seam_is_told_of_the_frame_that_it_is_at(last, words):
    from blender_addon.operators.baking import seam

    figures = {"loop: last frame": last, "loop: seam, at most [mm]": 6.04, "loop: seam from rest, at most [mm]": 41.2}
    assert seam(figures) == f"; the loop's {words} is within 6 mm of its first, 41.2 mm where it starts at rest"


def test_another_file_than_a_model_fails_in_one_sentence(ready, trained, folder):
    (folder / "broken.safetensors").write_bytes(b"no model")
    trained.ssilk.model = "//broken.safetensors"
    told = refused(ready, trained)
    assert "broken.safetensors" in told
    assert "Traceback" not in told


def test_a_garment_deleted_meanwhile_changes_nothing(ready, trained, monkeypatch):
    from blender_addon.operators import baking

    kept = baking.BakeGarment.finish
    monkeypatch.setattr(baking.BakeGarment, "finish", lambda self, *rest: remove(ready, trained) or kept(self, *rest))
    activate(ready, trained)
    with pytest.raises(RuntimeError, match="'Skirt' was deleted meanwhile"):
        ready.ops.ssilk.bake()


def remove(bpy, thing) -> None:
    bpy.data.objects.remove(thing)


def test_an_unsaved_file_can_bake_to_its_timeline_but_not_beside_itself(ready, trained):
    trained.ssilk.model = str(model_of(trained))
    ready.ops.wm.save_as_mainfile(filepath=ready.data.filepath, copy=True)
    from blender_addon.operators.baking import usd_path

    assert usd_path(trained, "//x.usdc").name == "x.usdc"
    from blender_addon.errors import SetupError

    with pytest.raises(SetupError, match="no name for a shot"):
        usd_path(trained, "//x.abc")


def test_a_bake_goes_on_from_the_previous_one(ready, trained):
    """Of the last frames alone: at rest the cloth would begin elsewhere."""
    scene = ready.context.scene
    assert ready.ops.ssilk.bake() == {"FINISHED"}
    whole = shown(ready, trained, range(25, 41))
    scene.frame_start = 25
    assert ready.ops.ssilk.bake(go_on=True) == {"FINISHED"}
    second = shown(ready, trained, range(25, 41))
    assert np.abs(second[0] - whole[0]).max() < 2e-4
    assert ready.ops.ssilk.bake(pre_roll=0.0) == {"FINISHED"}
    anew = shown(ready, trained, range(25, 41))
    assert np.abs(anew[0] - whole[0]).max() > 5 * np.abs(second[0] - whole[0]).max()
    assert np.abs(second - whole).max() < np.abs(anew - whole).max()
    assert ready.ops.ssilk.remove_bake() == {"FINISHED"}
    with pytest.raises(RuntimeError, match="No bake can go on from the previous one: nothing was baked for 'Skirt'"):
        ready.ops.ssilk.bake(go_on=True)
