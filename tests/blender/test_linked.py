# SPDX-License-Identifier: Apache-2.0
"""Characters that are linked from another file, or overridden: never modified, yet dressed."""

from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from .conftest import BONES, activate, add_mesh, tube
from .test_rigging import evaluated


@pytest.fixture(params=["linked", "overridden"])
def guest(request, ready, skirt, tmp_path):
    """A skirt of this file on a character of another one, whose armature is turned, scaled and placed elsewhere."""
    from mathutils import Matrix

    armature, path = ready.data.objects["Rig"], str(tmp_path / "Gäste char.blend")
    ready.data.objects.remove(skirt)
    placement = Matrix.LocRotScale((0.1, 0.2, 0), Matrix.Rotation(math.pi / 2, 3, "X").to_quaternion(), [0.01] * 3)
    armature.data.transform(placement.inverted())
    armature.matrix_world = placement
    group = ready.data.collections.new("Character")
    for thing in (armature, ready.data.objects["Pillar"]):
        group.objects.link(thing)
    ready.data.libraries.write(path, {group})
    ready.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with ready.data.libraries.load(path, link=True) as (_, wanted):
        wanted.collections = ["Character"]
    group = wanted.collections[0]
    ready.context.scene.collection.children.link(group)
    if request.param == "overridden":
        group.override_hierarchy_create(ready.context.scene, ready.context.view_layer, do_fully_editable=True)
    garment = add_mesh(ready, "Skirt", *tube(24, 13, (0.6, 1.0, 1.3), (0.5, 0.165, 0.165)))
    leader = next(thing for thing in ready.context.scene.objects if thing.type == "ARMATURE")
    garment.modifiers.new("Armature", "ARMATURE").object = garment.ssilk.armature = leader
    values = [2 if vertex.co.z < 0.9 else 1 for vertex in garment.data.vertices]
    garment.data.attributes.new("ssilk:class", "INT", "POINT").data.foreach_set("value", values)
    activate(ready, garment)
    return garment


def test_a_linked_character_stays_as_it_is_and_the_garment_follows(ready, guest):
    leader = guest.ssilk.armature
    assert leader.library or leader.override_library
    assert ready.ops.ssilk.generate_rig(proxies=5) == {"FINISHED"}
    follower = guest.ssilk.armature
    assert [modifier.object for modifier in guest.modifiers] == [follower]
    assert (follower.library, follower.override_library) == (None, None)
    assert [bone.name for bone in leader.data.bones] == list(BONES)
    assert len(follower.data.bones) == 3 + 5
    assert not leader.data.collections_all


def test_the_followers_bones_are_where_the_characters_are(ready, guest):
    leader, bones = guest.ssilk.armature, ("Hips", "Spine", "Head")
    ready.ops.ssilk.generate_rig(proxies=5)
    before = evaluated(ready, guest)
    if leader.override_library:
        leader.pose.bones["Spine"].rotation_quaternion = (0.9, 0.3, 0.1, 0.2)
        leader.location.z += 0.5
    ready.context.view_layer.update()
    follower = guest.ssilk.armature
    for name in bones:
        own, wanted = (thing.matrix_world @ thing.pose.bones[name].matrix for thing in (follower, leader))
        np.testing.assert_allclose(np.array(own), np.array(wanted), atol=1e-5)
    moved = np.linalg.norm(evaluated(ready, guest) - before, axis=1)
    assert (moved.max() > 0.1) == bool(leader.override_library)


def test_a_follower_is_generated_again_and_meets_the_same_bodies(ready, guest):
    from blender_addon.scene.garment import bodies_of
    from blender_addon.scene.gather import gather

    ready.ops.ssilk.generate_rig(proxies=5)
    follower = guest.ssilk.armature
    ready.ops.ssilk.generate_rig(proxies=3)
    assert guest.ssilk.armature == follower
    assert gather(guest).joints.proxy_count == 3
    assert [thing.name for thing in bodies_of(guest, follower)] == ["Pillar"]


def test_a_linked_garment_cannot_be_changed_and_says_so(ready, skirt, tmp_path):
    path = str(tmp_path / "garment.blend")
    ready.data.libraries.write(path, {skirt})
    ready.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with ready.data.libraries.load(path, link=True) as (_, wanted):
        wanted.objects = ["Skirt"]
    ready.context.scene.collection.objects.link(wanted.objects[0])
    ready.context.view_layer.objects.active = wanted.objects[0]
    with pytest.raises(RuntimeError, match=r"'Skirt' is linked from 'garment\.blend'; override it"):
        ready.ops.ssilk.paint_classes()


@pytest.mark.parametrize("overridden", [False, True])
def test_a_garment_gets_the_mesh_back_that_it_had(ready, skirt, tmp_path, overridden):
    """The linked one, or the shot's own override of it, in the file that was opened again as well."""
    from blender_addon.scene.linked import give_back_mesh, give_own_mesh, has_lent_mesh

    path, shot = str(tmp_path / "garment.blend"), str(tmp_path / "shot.blend")
    ready.data.libraries.write(path, {skirt})
    ready.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with ready.data.libraries.load(path, link=True) as (_, wanted):
        wanted.objects = ["Skirt"]
    garment = wanted.objects[0].override_create()
    ready.context.scene.collection.objects.link(garment)
    if overridden:
        garment.data = garment.data.override_create()
        garment.data.name = "Skirt of the shot"
    before = garment.data.name
    give_own_mesh(garment)
    assert garment.data.name == "Skirt shot" and has_lent_mesh(garment)
    ready.ops.wm.save_as_mainfile(filepath=shot)
    ready.ops.wm.open_mainfile(filepath=shot)
    (garment,) = ready.context.scene.objects
    give_back_mesh(garment)
    assert garment.data.name == before and bool(garment.data.override_library) == overridden
    assert "Skirt shot" not in ready.data.meshes and not has_lent_mesh(garment)


def test_classes_survive_linking(ready, skirt, tmp_path):
    from blender_addon.scene.classes import read_classes

    values = np.arange(len(skirt.data.vertices)) % 3
    skirt.data.attributes.new("ssilk:class", "INT", "POINT").data.foreach_set("value", values)
    path = str(tmp_path / "Röcke und mehr.blend")
    ready.data.libraries.write(path, {skirt})
    for link in (True, False):
        ready.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
        with ready.data.libraries.load(path, link=link) as (_, wanted):
            wanted.objects = ["Skirt"]
        np.testing.assert_array_equal(read_classes(wanted.objects[0].data), values)
