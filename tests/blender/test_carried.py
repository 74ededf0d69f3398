# SPDX-License-Identifier: Apache-2.0
"""Garments and bodies that are parented to a bone, as those of game characters are."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from .conftest import activate
from .scenes import animate, shown

FRAMES = range(1, 18, 4)


@pytest.fixture
def carried(bpy, skirt):
    """The skirt on the bone Spine of an armature that stands aside and moves, posed while it was parented."""
    rig = bpy.data.objects["Rig"]
    rig.location, rig.scale = (0.3, -0.2, 0.1), (1.1,) * 3
    bpy.data.objects["Pillar"].parent = rig
    animate(bpy, rig, "Walk", 0.3, 20)
    activate(bpy, skirt)
    bpy.context.scene.frame_set(1)
    bpy.context.view_layer.update()
    parent_to_bone(bpy, skirt, rig, "Spine")
    return skirt


def parent_to_bone(bpy, thing, rig, name) -> None:
    """Parent an object to a bone so that it keeps the place at rest that it has beside the armature."""
    thing.parent, thing.parent_type, thing.parent_bone = rig, "BONE", name
    rig.data.pose_position = "REST"
    bpy.context.view_layer.update()
    thing.matrix_world = rig.matrix_world.copy()
    rig.data.pose_position = "POSE"
    bpy.context.view_layer.update()


def gathered(bpy, garment, frame):
    from blender_addon.scene.gather import gather

    bpy.context.scene.frame_set(frame)
    return gather(garment, classes=False, proxies=False)


def test_a_carried_garment_is_the_same_in_every_pose(bpy, carried):
    first, later = (gathered(bpy, carried, frame) for frame in (1, 13))
    np.testing.assert_allclose(later.garment.mesh.points, first.garment.mesh.points, atol=2e-6)
    assert first.joints.names[first.garment.skin.only_joint] == "Spine"
    rig = np.array(bpy.data.objects["Rig"].matrix_world)
    points = np.array([vertex.co for vertex in carried.data.vertices]) @ rig[:3, :3].T + rig[:3, 3]
    np.testing.assert_allclose(first.units.points_from_core(first.garment.mesh.points), points, atol=2e-6)


def test_its_rig_moves_it_once_and_as_the_bone_did(ready, carried):
    before = shown(ready, carried, FRAMES)
    assert np.ptp(before, axis=0).max() > 0.05
    ready.context.scene.frame_set(13)
    assert ready.ops.ssilk.classify() == {"FINISHED"}
    assert ready.ops.ssilk.generate_rig(proxies=3) == {"FINISHED"}
    assert (carried.parent.name, carried.parent_type) == ("Rig", "OBJECT")
    assert carried.modifiers[0].type == "ARMATURE"
    np.testing.assert_allclose(shown(ready, carried, FRAMES), before, atol=2e-5)
    again = gathered(ready, carried, 5)
    assert again.joints.names[again.garment.skin.only_joint] == "Spine"


def test_what_would_move_twice_is_not_trained(bpy, carried):
    from blender_addon.errors import SetupError
    from blender_addon.playback.bake import need_bakeable
    from blender_addon.scene.armature import read_joints

    rig = bpy.data.objects["Rig"]
    carried.modifiers.new("Armature", "ARMATURE").object = rig
    with pytest.raises(SetupError, match="'Skirt' hangs on the bone 'Spine', which moves it besides its weights"):
        need_bakeable(carried, rig, read_joints(rig, carried))


def test_a_bone_that_does_not_deform_is_named(bpy, carried):
    from blender_addon.errors import SetupError

    bpy.data.objects["Rig"].data.bones["Spine"].use_deform = False
    with pytest.raises(SetupError, match="hangs on the bone 'Spine', which does not deform"):
        gathered(bpy, carried, 1)


def test_a_shield_counts_where_it_is_chosen_or_nothing_else_does(bpy, carried):
    rig, pillar = bpy.data.objects["Rig"], bpy.data.objects["Pillar"]
    shield = pillar.copy()
    shield.modifiers.clear()
    shield.name = "Shield"
    bpy.context.collection.objects.link(shield)
    empty = bpy.data.objects.new("Socket", None)
    bpy.context.collection.objects.link(empty)
    shield.parent = empty
    parent_to_bone(bpy, empty, rig, "Head")
    assert list(gathered(bpy, carried, 1).meshes) == ["Skirt", "Pillar"]
    chosen = bpy.data.collections.new("Bodies")
    chosen.objects.link(shield)
    carried.ssilk.bodies = chosen
    scene = gathered(bpy, carried, 9)
    assert list(scene.meshes) == ["Skirt", "Shield"]
    assert scene.joints.names[scene.character.bodies[0].skin.only_joint] == "Head"
    carried.ssilk.bodies = None
    bpy.data.objects.remove(pillar)
    assert list(gathered(bpy, carried, 1).meshes) == ["Skirt", "Shield"]
