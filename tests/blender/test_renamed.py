# SPDX-License-Identifier: Apache-2.0
"""Bones and proxies that were renamed after the training, and characters that were scaled."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from blender_addon.arrays.joints import Joints
from blender_addon.arrays.renamed import TrainedJoints, growth, known_as, lost, renames

from .conftest import activate
from .scenes import proxies_of, shown

EXACT = 1e-5  # [m]
FRAMES = range(1, 41)
NAMES = ("Hips", "Spine", "Leg.L", "Leg.R", "hem.1", "hem.2")
PLACES = ((0, 1, 0), (0, 1.3, 0), (0.1, 0.9, 0), (-0.1, 0.9, 0), (0.1, 0.5, 0.1), (-0.1, 0.5, 0.1))


@pytest.fixture
def joints() -> Joints:
    binds = np.tile(np.eye(4), (6, 1, 1))
    binds[:, :3, 3] = PLACES
    return Joints(NAMES, np.array([-1, 0, 0, 0, 2, 3]), binds, proxy_count=2)


@pytest.fixture
def known_then(joints) -> TrainedJoints:
    return TrainedJoints(joints.paths, joints.binds)


def renamed(joints: Joints, **names: str) -> Joints:
    return replace(joints, names=tuple(names.get(name.replace(".", "_"), name) for name in joints.names))


def test_bones_are_found_again_by_their_places_in_their_parents(joints, known_then):
    other = renamed(joints, Hips="Becken", Leg_L="Bein links", hem_1="saum")
    known = known_as(other, known_then, {})
    assert known.paths == known_then.names and not lost(known, known_then)
    assert renames(known) == {"Becken": "Hips", "Bein links": "Leg_L", "saum": "hem_1"}
    assert known_as(joints, known_then, {}) is joints


def test_exchanged_names_stay_names(joints, known_then):
    """Who exchanges left and right means it, and hears that the bones have moved."""
    other = renamed(joints, Leg_L="Leg.R", Leg_R="Leg.L")
    assert [path.rpartition("/")[2] for path in known_as(other, known_then, {}).paths[2:4]] == ["Leg_R", "Leg_L"]


def test_bones_in_one_place_are_for_the_artist_to_tell(joints, known_then):
    binds = joints.binds.copy()
    binds[3] = binds[2]
    twins, other = TrainedJoints(joints.paths, binds), replace(renamed(joints, Leg_L="a", Leg_R="b"), binds=binds)
    assert lost(known_as(other, twins, {}), twins) == ["Leg_L", "Leg_R", "hem_1", "hem_2"]
    assert known_as(other, twins, {"a": "Leg_L", "b": "Leg_R"}).paths == twins.names
    assert known_as(other, twins, {"b": "Leg_R"}).paths == twins.names  # one is left


def test_a_bone_that_moved_as_well_is_not_guessed(joints, known_then):
    binds = joints.binds.copy()
    binds[2, 1, 3] -= 0.1
    other = replace(renamed(joints, Leg_L="a"), binds=binds)
    assert lost(known_as(other, known_then, {}), known_then) == ["Leg_L", "hem_1"]


def test_a_character_of_another_size_is_known_and_its_size_too(joints, known_then):
    big = joints.binds.copy()
    big[:, :3, 3] = 1.5 * big[:, :3, 3] + (3, 0, 1)
    known = known_as(replace(renamed(joints, Leg_L="a"), binds=big), known_then, {})
    assert not lost(known, known_then)
    assert growth(known, known_then) == pytest.approx(1.5)
    assert growth(joints, known_then) == 1
    other = joints.binds.copy()
    other[2, 0, 3] += 0.3
    assert growth(replace(joints, binds=other), known_then) == 1


@pytest.mark.parametrize("stage", [True, False])
def test_a_bake_of_renamed_bones_shows_what_it_showed(ready, trained, tmp_path, capfd, stage):
    skirt, armature = trained, ready.data.objects["Rig"]
    assert ready.ops.ssilk.bake() == {"FINISHED"}
    before = shown(ready, skirt, FRAMES)
    assert ready.ops.ssilk.remove_bake() == {"FINISHED"}
    if not stage:  # as where a model was copied without the folder of its training
        from shutil import copy

        from blender_addon.playback.models import model_of

        skirt.ssilk.model = str(copy(model_of(skirt), tmp_path / "chosen.safetensors"))
    rename(armature)
    capfd.readouterr()
    assert ready.ops.ssilk.bake() == {"FINISHED"}
    assert "3 bones are called otherwise than in the training and matched, as 'Becken', which was 'Hips'" in (
        capfd.readouterr().out
    )
    assert np.abs(shown(ready, skirt, FRAMES) - before).max() < EXACT
    assert ready.ops.ssilk.remove_bake() == {"FINISHED"}
    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    assert np.abs(shown(ready, skirt, FRAMES) - before).max() < 1e-4


def rename(armature) -> None:
    for old, new in (("Hips", "Becken"), ("Spine", "Wirbel.1"), ("Skirt_proxy_03", "Saum")):
        armature.data.bones[old].name = new


def test_what_only_the_artist_can_tell_is_asked(ready, trained):
    skirt, armature = trained, ready.data.objects["Rig"]
    edit = armature.data.edit_bones
    activate(ready, armature)
    ready.ops.object.mode_set(mode="EDIT")
    edit["Head"].name = "Kopf"
    edit["Kopf"].roll += 0.5  # no longer in its place
    ready.ops.object.mode_set(mode="OBJECT")
    activate(ready, skirt)
    with pytest.raises(RuntimeError, match="tell which bone it is by Match Bones in the Baking panel"):
        ready.ops.ssilk.bake()
    assert ready.ops.ssilk.match_bones() == {"FINISHED"}
    assert [item.name for item in skirt.ssilk.bones] == ["Head"]
    skirt.ssilk.bones[0].bone = "Kopf"
    assert ready.ops.ssilk.match_bones() == {"FINISHED"}
    assert [(item.name, item.bone) for item in skirt.ssilk.bones] == [("Head", "Kopf")]
    with pytest.raises(RuntimeError, match=r"'Kopf'.* was moved since|bound .* from where the model has it"):
        ready.ops.ssilk.bake()


@pytest.mark.parametrize("act", ["bake", "play_live"])
def test_a_scaled_character_is_told_as_scaled(ready, trained, act):
    skirt, armature = trained, ready.data.objects["Rig"]
    skirt.parent = armature
    armature.scale = (1.25,) * 3
    ready.context.view_layer.update()
    wanted = r"'Rig' is scaled to 1\.25 times its size when 'Skirt' was trained, .* scale it to 1 \(now 1\.25\)"
    with pytest.raises(RuntimeError, match=wanted):
        getattr(ready.ops.ssilk, act)()
    assert proxies_of(ready)


def test_a_scale_that_is_animated_is_told_with_its_frame(ready, trained):
    skirt, armature = trained, ready.data.objects["Rig"]
    skirt.parent = armature
    for frame, scale in ((1, 1.0), (20, 1.0), (30, 1.5)):
        armature.scale = (scale,) * 3
        armature.keyframe_insert("scale", frame=frame)
    ready.context.scene.frame_set(1)
    with pytest.raises(RuntimeError, match=r"'Rig' is scaled 1\.0.* at frame 2[1-9] of 'Timeline' and 1 in"):
        ready.ops.ssilk.bake()
