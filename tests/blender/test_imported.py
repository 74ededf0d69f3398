# SPDX-License-Identifier: Apache-2.0
"""Characters from files: rigged stages by Blender's USD importer, and round trips through FBX and BVH."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from .conftest import BONES, ROOT, activate
from .scenes import weights_of
from .test_rigging import contract_of

SHARED = ROOT.parent / "shared" / "data"


@pytest.fixture
def stage(ready, skirt, ssilk_python, folder) -> Path:
    """A stage of the skirt that `ssilk rig` wrote, under a path that is hard to spell."""
    from blender_addon.scene.gather import gather
    from blender_addon.scene.handover import hand_over
    from blender_addon.scene.objects import Pair

    rigged = folder / "rigged stage.usdc"
    if not rigged.exists():
        given = hand_over(gather(skirt), Pair.of(skirt, ready.data.objects["Rig"]), folder)
        command = [ssilk_python, "-m", "ssilk_core", "rig", str(given.stage), "-o", str(rigged), "--proxies", "5"]
        subprocess.run([*command, "--garment", given.prim], check=True, capture_output=True, env={})
    ready.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    return rigged


def armature_of(bpy):
    return next(thing for thing in bpy.data.objects if thing.type == "ARMATURE")


def test_a_rigged_stage_comes_in_with_its_proxies(ready, stage, ssilk_python, tmp_path):
    assert ready.ops.ssilk.import_stage(filepath=str(stage)) == {"FINISHED"}
    skirt, armature = ready.data.objects["Skirt"], armature_of(ready)
    from blender_addon.panels.rig import rig_line
    from blender_addon.scene.armature import proxy_names
    from blender_addon.scene.classes import read_classes

    assert len(proxy_names(armature, skirt)) == 5
    assert rig_line(skirt) == f"5 proxies on '{armature.name}'"
    assert set(read_classes(skirt.data)) >= {1, 2}
    said = contract_of(skirt, ssilk_python, tmp_path / "again.usdc")
    assert [name.rpartition("/")[2] for name in said["joints"]] == list(BONES)
    assert len(said["proxies"]) == 5
    np.testing.assert_allclose(np.array(said["weights"]).sum(axis=1), 1, atol=1e-5)


def test_what_was_adopted_is_known_when_it_is_edited(ready, stage):
    from blender_addon.rigging.edit_tracking import find_edits

    ready.ops.wm.usd_import(filepath=str(stage))
    ready.ops.ssilk.adopt_rig(filepath=str(stage))
    skirt, armature = ready.data.objects["Skirt"], armature_of(ready)
    assert find_edits(armature, skirt).summary == ""
    activate(ready, armature)
    ready.ops.object.mode_set(mode="EDIT")
    armature.data.edit_bones[-1].tail.x += 0.1
    ready.ops.object.mode_set(mode="OBJECT")
    activate(ready, skirt)
    assert find_edits(armature, skirt).summary == "1 moved"
    assert ready.ops.ssilk.generate_rig(proxies=5) == {"FINISHED"}
    assert find_edits(armature, skirt).summary == "1 moved"
    np.testing.assert_allclose(weights_of(skirt).sum(axis=1), 1, atol=1e-5)


def test_a_stage_that_cannot_be_adopted_says_why(ready, stage, tmp_path):
    bad = tmp_path / "bad.usda"
    bad.write_text("no usd")
    plain = tmp_path / "plain.usda"
    plain.write_text('#usda 1.0\ndef Mesh "Skirt" {}\n')
    for path, reason in (
        (tmp_path / "none.usdc", "There is no file"),
        (bad, "bad.usda: it cannot be read as USD"),
        (plain, "No mesh of 'plain.usda' has proxies"),
        (stage, "No mesh of this scene is 'Skirt'"),
    ):
        with pytest.raises(RuntimeError, match=reason) as raised:
            ready.ops.ssilk.adopt_rig(filepath=str(path))
        assert "Traceback" not in str(raised.value)


def round_trip_fbx(bpy, path: Path) -> None:
    bpy.ops.export_scene.fbx(filepath=str(path), add_leaf_bones=False)
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    bpy.ops.import_scene.fbx(filepath=str(path), automatic_bone_orientation=False)


def test_a_character_from_fbx_is_dressed(ready, skirt, ssilk_python, tmp_path):
    """FBX leaves armatures in centimetres, scaled and turned: what ssilk reads is where it was."""
    from blender_addon.scene.gather import gather

    before = gather(skirt)
    round_trip_fbx(ready, tmp_path / "char äöü.fbx")
    garment = ready.data.objects["Skirt"]
    activate(ready, garment)
    after = gather(garment)
    assert after.joints.names == before.joints.names
    np.testing.assert_allclose(after.joints.binds[:, :3, 3], before.joints.binds[:, :3, 3], atol=1e-5)
    np.testing.assert_allclose(after.garment.mesh.points, before.garment.mesh.points, atol=1e-5)
    own, wanted = (scene.character.bodies[0].skin.dense(3) for scene in (after, before))
    np.testing.assert_allclose(own, wanted, atol=1e-5)
    assert ready.ops.ssilk.classify() == {"FINISHED"}
    assert ready.ops.ssilk.generate_rig(proxies=4) == {"FINISHED"}
    said = contract_of(garment, ssilk_python, tmp_path / "fbx.usdc")
    heights = np.array(said["proxy_binds"])[:, 1, 3]
    assert ((heights > 0.5) & (heights < 1.4)).all()


def test_a_motion_from_bvh_moves_the_garment(ready, skirt, tmp_path):
    """A BVH brings an armature of its own: the garment is then asked which one is meant."""
    armature = ready.data.objects["Rig"]
    for frame, angle in ((1, 0.0), (10, 0.5)):
        armature.pose.bones["Spine"].rotation_mode = "XYZ"
        armature.pose.bones["Spine"].rotation_euler.x = angle
        armature.pose.bones["Spine"].keyframe_insert("rotation_euler", frame=frame)
    activate(ready, armature)
    path = str(tmp_path / "walk.bvh")
    ready.ops.export_anim.bvh(filepath=path, frame_start=1, frame_end=10)
    ready.ops.import_anim.bvh(filepath=path)
    activate(ready, skirt)
    with pytest.raises(RuntimeError, match="'Skirt' could belong to 'Rig', 'walk'; choose its armature"):
        ready.ops.ssilk.classify()
    skirt.ssilk.armature = armature
    assert ready.ops.ssilk.classify() == {"FINISHED"}


@pytest.mark.skipif(not SHARED.exists(), reason="the shared data is not beside the checkout")
@pytest.mark.parametrize("name", ["pants", "long_sleeve"])
def test_real_garments_on_a_real_character(ready, name):
    """Imported by Blender: y up becomes z up, and nothing of the garment is bound."""
    ready.ops.wm.usd_import(filepath=str(SHARED / "character.usdc"))
    before = set(ready.data.objects)
    ready.ops.wm.usd_import(filepath=str(SHARED / "garments" / f"{name}.usdc"))
    (garment,) = (thing for thing in set(ready.data.objects) - before if thing.type == "MESH")
    activate(ready, garment)
    assert ready.ops.ssilk.inspect() == {"FINISHED"}
    assert not [item for item in ready.context.window_manager.ssilk_preflight.findings if item.severity == "error"]
    assert ready.ops.ssilk.classify() == {"FINISHED"}
    from blender_addon.panels.classes import class_counts

    pinned, tight, loose = class_counts(garment)
    assert pinned > 0 and tight > 0
    assert loose < 0.2 * len(garment.data.vertices)
    assert ready.ops.ssilk.generate_rig(proxies=3) == {"FINISHED"}
    np.testing.assert_allclose(weights_of(garment).sum(axis=1), 1, atol=1e-5)
