# SPDX-License-Identifier: Apache-2.0
"""Automatic classes and proxy rigs through the external Python, and scenes that cannot be rigged."""

from __future__ import annotations

import json
import math
import subprocess
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from .conftest import BONES, HEIGHTS, activate, add_armature
from .scenes import proxies_of, weights_of

READ = """
import json, sys
from ssilk_usd.reading.scene import read_scene
character, garment, rig = read_scene(sys.argv[1])
print(json.dumps({
    "joints": character.skeleton.joint_names, "binds": character.skeleton.bind_transforms[:, :3, 3].tolist(),
    "points": garment.mesh.points.tolist(), "classes": garment.classes.tolist(),
    "plain": None if garment.skin is None else garment.skin.dense(character.skeleton.joint_count).tolist(),
    "proxies": rig and rig.joint_names, "parents": rig and rig.parents.tolist(),
    "proxy_binds": rig and rig.bind_transforms.tolist(),
    "weights": rig and rig.skin.dense(character.skeleton.joint_count + rig.proxy_count).tolist(),
}))
"""


def test_hem_is_loose_and_waist_is_not(classified):
    from blender_addon.scene.classes import read_classes

    heights = np.array([vertex.co.z for vertex in classified.data.vertices])
    values = read_classes(classified.data)
    assert (values[heights < 0.75] == 2).all()
    assert (values[heights > 1.15] < 2).all()


def test_tightness_slides_from_what_is_pinned_to_all(ready, classified):
    from blender_addon.scene.classes import read_classes

    found = read_classes(classified.data)
    tight = []
    for tightness in (0.0, 0.3, 0.5, 0.8, 1.0):
        classified.ssilk.tightness = tightness
        now = read_classes(classified.data)
        np.testing.assert_array_equal(now == 0, found == 0)
        tight.append(int((now == 1).sum()))
        if tightness == 0.5:
            np.testing.assert_array_equal(now, found)
    assert tight[0] == 0 and tight[-1] == int((found != 0).sum())
    assert tight == sorted(tight) and len(set(tight)) >= 4
    classified.data.attributes.remove(classified.data.attributes["ssilk:tightness"])
    classified.ssilk.tightness = 0.0  # what was painted stays
    assert (read_classes(classified.data) != 2).all()


def test_pins_come_from_a_vertex_group(ready, classified):
    from blender_addon.scene.classes import read_classes

    ring = [vertex.index for vertex in classified.data.vertices if vertex.co.z < 0.62]
    classified.vertex_groups.new(name="Hem").add(ring, 0.6, "REPLACE")
    classified.ssilk.pins, classified.ssilk.tightness = "Hem", 0.5
    assert ready.ops.ssilk.classify() == {"FINISHED"}
    classes = read_classes(classified.data)
    assert np.flatnonzero(classes == 0).tolist() == ring and (classes == 1).any()
    classified.ssilk.pins = "None"
    with pytest.raises(RuntimeError, match="has no vertex group 'None' for its pins"):
        ready.ops.ssilk.classify()


def test_a_rig_is_bones_groups_and_a_modifier(ready, rigged):
    armature = ready.data.objects["Rig"]
    proxies = proxies_of(ready)
    assert len(proxies) == 6
    (collection,) = (group for group in armature.data.collections_all if group.get("ssilk_garment") == rigged)
    assert {bone.name for bone in collection.bones} == set(proxies)
    assert all(armature.data.bones[name].parent and armature.data.bones[name].use_deform for name in proxies)
    assert rigged.modifiers[0].object == armature
    np.testing.assert_allclose(weights_of(rigged).sum(axis=1), 1, atol=1e-6)
    assert set(rigged.vertex_groups.keys()) & set(proxies)
    assert ready.context.mode == "OBJECT"
    assert ready.context.view_layer.objects.active == rigged


def test_a_proxy_moves_vertices_by_their_weights(ready, rigged):
    before = evaluated(ready, rigged)
    name = next(name for name in proxies_of(ready) if name in rigged.vertex_groups)
    bone = ready.data.objects["Rig"].pose.bones[name]
    bone.location = (0.0, 0.1, 0.0)
    moved = np.linalg.norm(evaluated(ready, rigged) - before, axis=1)
    chain = {name, *(child.name for child in bone.children_recursive)}
    below = [group.index for group in rigged.vertex_groups if group.name in chain]
    np.testing.assert_allclose(moved, 0.1 * weights_of(rigged)[:, below].sum(axis=1), atol=1e-6)
    assert moved.max() > 0.01


def evaluated(bpy, thing) -> np.ndarray:
    bpy.context.view_layer.update()
    mesh = thing.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    points = np.empty(len(mesh.vertices) * 3, dtype=np.float32)
    mesh.vertices.foreach_get("co", points)
    return points.reshape(-1, 3)


def contract_of(thing, python: str, path: Path) -> dict:
    """What ssilk reads of a garment that Blender hands over."""
    from ssilk_usd.writing.files import write_scene

    from blender_addon.scene.gather import gather

    scene = gather(thing)
    write_scene(path, scene.character, scene.garment, scene.rig, units=scene.units)
    done = subprocess.run([python, "-c", READ, str(path)], capture_output=True, text=True, check=True, env={})
    return json.loads(done.stdout)


def test_edits_by_hand_reach_ssilk(ready, rigged, ssilk_python, tmp_path):
    armature = ready.data.objects["Rig"]
    activate(ready, armature)
    ready.ops.object.mode_set(mode="EDIT")
    bones = armature.data.edit_bones
    first, second = proxies_of(ready)[:2]
    bones[first].head.z += 0.05
    bones[first].name = "Train.L"
    own = bones.new("Ribbon")
    own.head, own.tail, own.parent = (0.4, 0, 0.7), (0.4, 0, 0.6), bones["Train.L"]
    bones.remove(bones[second])
    ready.ops.object.mode_set(mode="OBJECT")
    activate(ready, rigged)
    said = contract_of(rigged, ssilk_python, tmp_path / "edited.usdc")
    assert said["joints"] == ["Hips", "Hips/Spine", "Hips/Spine/Head"]
    leaves = [name.rpartition("/")[2] for name in said["proxies"]]
    assert len(leaves) == 6
    assert {"Train_L", "Ribbon"} <= set(leaves)
    ribbon = leaves.index("Ribbon")
    assert said["parents"][ribbon] == 3 + leaves.index("Train_L")
    np.testing.assert_allclose(np.array(said["proxy_binds"])[ribbon, :3, 3], (0.4, 0.7, 0), atol=1e-6)


def test_what_was_written_comes_back_the_same(ready, rigged, ssilk_python, tmp_path):
    """Weights, bones and points in Blender are those that ssilk made, through world space and back."""
    said = contract_of(rigged, ssilk_python, tmp_path / "dressed.usdc")
    order = [*BONES, *(name for name in proxies_of(ready))]
    groups = weights_of(rigged)
    columns = [groups[:, rigged.vertex_groups[name].index] if name in rigged.vertex_groups else 0 * groups[:, 0]
               for name in order]  # fmt: skip
    np.testing.assert_allclose(np.array(said["weights"]), np.stack(columns, axis=1), atol=1e-6)
    points = np.array([vertex.co for vertex in rigged.data.vertices])
    np.testing.assert_allclose(np.array(said["points"]), points[:, [0, 2, 1]] * [1, 1, -1], atol=1e-6)


def test_an_armature_that_is_placed_and_scaled_makes_no_difference(ready, classified, ssilk_python, tmp_path):
    """Imports from centimetres leave armatures scaled by 0.01 and turned: bones go where they belong all the same."""
    from mathutils import Matrix

    armature = ready.data.objects["Rig"]
    placement = Matrix.LocRotScale((0.3, -0.2, 0.1), Matrix.Rotation(math.pi / 2, 3, "X").to_quaternion(), [0.01] * 3)
    armature.data.transform(placement.inverted())
    armature.matrix_world = placement
    ready.context.view_layer.update()
    assert ready.ops.ssilk.generate_rig(proxies=6) == {"FINISHED"}
    said = contract_of(classified, ssilk_python, tmp_path / "placed.usdc")
    np.testing.assert_allclose(np.array(said["binds"])[:, 1], (0.8, 1.2, 1.5), atol=1e-5)
    proxies = np.array(said["proxy_binds"])[:, :3, 3]
    assert (np.linalg.norm(proxies[:, [0, 2]], axis=1) < 0.6).all()
    assert ((proxies[:, 1] > 0.5) & (proxies[:, 1] < 1.4)).all()


def test_a_second_rig_replaces_the_first(ready, rigged):
    for keep in (True, False):
        ready.ops.ssilk.generate_rig(proxies=4, keep_edits=keep)
        assert len(proxies_of(ready)) == 4
        assert set(rigged.vertex_groups.keys()) <= {*BONES, *proxies_of(ready)}
        assert len(ready.data.objects["Rig"].data.collections_all) == 1


def test_a_garment_with_nothing_loose_follows_the_body(ready, skirt):
    skirt.data.attributes.new("ssilk:class", "INT", "POINT").data.foreach_set("value", [1] * len(skirt.data.vertices))
    assert ready.ops.ssilk.generate_rig() == {"FINISHED"}
    assert (proxies_of(ready), len(ready.data.armatures["Rig"].collections_all)) == ([], 0)
    assert set(skirt.vertex_groups.keys()) <= set(BONES)
    np.testing.assert_allclose(weights_of(skirt).sum(axis=1), 1, atol=1e-6)
    assert skirt.modifiers[0].object.name == "Rig"


def test_classes_and_rigs_are_undone(ready, rigged):
    ready.ops.ed.undo_push(message="before")
    ready.ops.ssilk.generate_rig(proxies=4, keep_edits=False)
    assert len(proxies_of(ready)) == 4
    ready.ops.ed.undo()
    assert len(proxies_of(ready)) == 6
    thing = ready.data.objects["Skirt"]
    np.testing.assert_allclose(weights_of(thing).sum(axis=1), 1, atol=1e-6)


def test_an_artists_weights_are_kept_beside_the_rig(ready, classified, ssilk_python, tmp_path):
    skirt = classified
    heights = np.array([vertex.co.z for vertex in skirt.data.vertices])
    for name, inside in (("Hips", heights < 1.1), ("Spine", heights >= 1.1)):
        skirt.vertex_groups.new(name=name).add(np.flatnonzero(inside).tolist(), 1.0, "REPLACE")
    for keep in (False, True):
        ready.ops.ssilk.generate_rig(proxies=4, keep_edits=keep)
        plain = np.array(contract_of(skirt, ssilk_python, tmp_path / f"{keep}.usdc")["plain"])
        np.testing.assert_allclose(plain, np.stack([heights < 1.1, heights >= 1.1, 0 * heights], axis=1), atol=1e-6)


def test_a_rig_survives_saving_and_renaming(ready, rigged, tmp_path):
    rigged.name = "Röckchen"
    path = str(tmp_path / "a b.blend")
    ready.ops.wm.save_as_mainfile(filepath=path)
    ready.ops.wm.open_mainfile(filepath=path)
    from blender_addon.panels.classes import class_counts
    from blender_addon.panels.rig import rig_line

    thing = ready.data.objects["Röckchen"]
    assert rig_line(thing) == "6 proxies on 'Rig'"
    assert sum(class_counts(thing)) == len(thing.data.vertices)


def test_another_garments_proxies_are_no_joints_of_the_character(ready, rigged):
    from blender_addon.scene.garment import bodies_of
    from blender_addon.scene.gather import gather

    other = rigged.copy()
    other.data = rigged.data.copy()
    other.name = "Apron"
    ready.context.collection.objects.link(other)
    scene = gather(other)
    assert (scene.joints.names, scene.joints.proxy_count, scene.rig) == (BONES, 0, None)
    assert [thing.name for thing in bodies_of(other, ready.data.objects["Rig"])] == ["Pillar"]


def test_what_ssilk_cannot_do_is_told_in_blenders_words(ready, skirt):
    """A garment that is loose all over is nowhere held."""
    skirt.data.attributes.new("ssilk:class", "INT", "POINT").data.foreach_set("value", [2] * len(skirt.data.vertices))
    with pytest.raises(RuntimeError, match="'Skirt'") as raised:
        ready.ops.ssilk.generate_rig(proxies=4)
    for word in ("Traceback", "/Character", ".usdc"):
        assert word not in str(raised.value)
    assert not proxies_of(ready)


def two_armatures(bpy, skirt):
    add_armature(bpy).name = "Twin"


def no_armature(bpy, skirt):
    bpy.data.objects.remove(bpy.data.objects["Rig"])


def unequal_scale(bpy, skirt):
    bpy.data.objects["Rig"].scale = (1, 1, 2)


def mirror_modifier(bpy, skirt):
    skirt.modifiers.new("Mirror", "MIRROR")


def no_body(bpy, skirt):
    bpy.data.objects.remove(bpy.data.objects["Pillar"])


def unbound_body(bpy, skirt):
    skirt.ssilk.bodies = bpy.data.collections.new("Colliders")
    skirt.ssilk.bodies.objects.link(skirt.copy())


def bare_vertices(bpy, skirt):
    bpy.data.objects["Pillar"].vertex_groups["Head"].remove([280])


def half_bound(bpy, skirt):
    skirt.vertex_groups.new(name="Hips").add([0], 1.0, "REPLACE")


def no_deform(bpy, skirt):
    for bone in bpy.data.armatures["Rig"].bones:
        bone.use_deform = False


MALFORMED = {
    two_armatures: "'Skirt' could belong to 'Rig', 'Twin'; choose its armature",
    no_armature: "There is no armature for 'Skirt'",
    unequal_scale: "'Rig' is scaled unequally or mirrored; apply its scale",
    mirror_modifier: "The modifier 'Mirror' of 'Skirt' gives it parts that its mesh does not have; apply it",
    no_body: "No body is bound to 'Rig'",
    unbound_body: "'Skirt.001' is not bound to 'Rig'; bind it, or take it from 'Colliders'",
    bare_vertices: "1 of 288 vertices of 'Pillar' have no bone's weight",
    half_bound: "311 of 312 vertices of 'Skirt' have no bone's weight",
    no_deform: "No bone of 'Rig' deforms",
}


@pytest.mark.parametrize("spoil, sentence", MALFORMED.items(), ids=lambda item: getattr(item, "__name__", ""))
def test_a_malformed_scene_is_one_sentence(ready, skirt, spoil, sentence):
    spoil(ready, skirt)
    activate(ready, skirt)
    ready.context.view_layer.update()
    with pytest.raises(RuntimeError, match=sentence) as raised:
        ready.ops.ssilk.classify()
    assert "Traceback" not in str(raised.value)
    assert "ssilk:class" not in skirt.data.attributes


def test_a_hidden_armature_cannot_be_rigged(ready, classified):
    ready.data.objects["Rig"].hide_set(True)
    with pytest.raises(RuntimeError, match="'Rig' is hidden or excluded"):
        ready.ops.ssilk.generate_rig()


def test_a_body_is_taken_as_its_modifiers_shape_it(ready, skirt):
    """Half a pillar with a mirror collides as a whole one."""
    from blender_addon.scene.gather import gather

    pillar = ready.data.objects["Pillar"]
    mirror = pillar.modifiers.new("Mirror", "MIRROR")
    mirror.use_axis = (False, False, True)
    pillar.modifiers.move(1, 0)
    armature = ready.data.objects["Rig"]
    armature.pose.bones["Hips"].location = (3.0, 0.0, 0.0)
    ready.context.view_layer.update()
    (body,) = gather(skirt).character.bodies
    assert body.mesh.vertex_count > len(pillar.data.vertices)
    assert np.abs(body.mesh.points[:, 0]).max() < 0.2
    assert armature.data.pose_position == "POSE"


def test_what_ssilk_has_is_in_metres_with_y_up(bpy, skirt):
    from blender_addon.scene.gather import gather

    bpy.context.scene.unit_settings.scale_length = 0.01
    skirt.data.uv_layers.new()
    scene = gather(skirt)
    points = np.array([vertex.co for vertex in skirt.data.vertices]) @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    np.testing.assert_allclose(scene.garment.mesh.points, 0.01 * points, atol=1e-8)
    np.testing.assert_allclose(scene.joints.binds[:, :3, 3], [(0, 0.01 * z, 0) for z in HEIGHTS], atol=1e-8)
    uvs = [loop.uv[:] for loop in skirt.data.uv_layers.active.data]
    np.testing.assert_allclose(scene.garment.mesh.uvs, uvs, atol=1e-6)
    assert {name: mesh.path for name, mesh in scene.meshes.items()} == {
        "Skirt": "/Character/Skirt", "Pillar": "/Character/Pillar",
    }  # fmt: skip
    assert (scene.garment.skin, scene.garment.classes, scene.rig) == (None, None, None)


def test_faces_of_a_mirrored_object_are_turned_over(bpy, skirt):
    from ssilk_usd.reading.polygons import triangulate

    from blender_addon.scene.gather import gather

    def outward(mesh, faces) -> bool:
        a, b, c = np.moveaxis(mesh.points[faces], 1, 0)
        middles = (a + b + c) * [1, 0, 1]
        return bool((np.cross(b - a, c - a) * middles).sum(axis=1).min() > 0)

    skirt.scale.x = -1
    bpy.context.view_layer.update()
    mesh = gather(skirt).garment.mesh
    written = triangulate(mesh.points, mesh.polygon_counts, mesh.polygon_indices)
    assert outward(mesh, mesh.faces) and outward(mesh, written)


def test_nothing_runs_before_the_python_was_checked(bpy, skirt):
    bpy.context.preferences.addons["blender_addon"].preferences.python = "/nowhere/python"
    with pytest.raises(RuntimeError, match="was not checked yet"):
        bpy.ops.ssilk.classify()
    with pytest.raises(RuntimeError, match="/nowhere/python cannot be started"):
        bpy.ops.ssilk.check_python()


def test_a_garment_deleted_meanwhile_is_told(ready, skirt, monkeypatch):
    from blender_addon.operators import rig

    def gone(self, context, work):
        ready.data.objects.remove(skirt)
        return original(self, context, work)

    original = rig.Classify.finish
    monkeypatch.setattr(rig.Classify, "finish", gone)
    with pytest.raises(RuntimeError, match="'Skirt' was deleted meanwhile"):
        ready.ops.ssilk.classify()


def test_an_environment_is_made_only_online(bpy):
    with pytest.raises(RuntimeError, match="Blender may not go online"):
        bpy.ops.ssilk.create_environment()


def test_shape_keys_stay_on_top_of_the_rig(ready, classified):
    """Corrective shapes act before the bones, as the artist made them."""
    classified.shape_key_add(name="Basis")
    classified.shape_key_add(name="Wide").data[20].co.x += 0.1
    assert ready.ops.ssilk.generate_rig(proxies=4) == {"FINISHED"}
    assert classified.data.shape_keys.key_blocks["Wide"].data[20].co.x == pytest.approx(
        classified.data.vertices[20].co.x + 0.1
    )


def test_a_hidden_body_counts_and_an_excluded_one_must_be_chosen(ready, skirt):
    from blender_addon.scene.garment import bodies_of

    group = ready.data.collections.new("Away")
    ready.context.scene.collection.children.link(group)
    pillar = ready.data.objects["Pillar"]
    ready.context.scene.collection.objects.unlink(pillar)
    group.objects.link(pillar)
    pillar.hide_set(True)
    pillar.hide_viewport = True
    assert bodies_of(skirt, ready.data.objects["Rig"]) == [pillar]
    ready.context.view_layer.layer_collection.children["Away"].exclude = True
    with pytest.raises(RuntimeError, match="No body is bound to 'Rig'"):
        ready.ops.ssilk.classify()
    skirt.ssilk.bodies = group
    assert ready.ops.ssilk.classify() == {"FINISHED"}


def test_an_armature_that_is_renamed_meanwhile_is_found(ready, classified, monkeypatch):
    from blender_addon.operators import rig

    original = rig.GenerateRig.finish

    def renamed(self, context, work):
        ready.data.objects["Rig"].name = "Gerüst"
        return original(self, context, work)

    monkeypatch.setattr(rig.GenerateRig, "finish", renamed)
    assert ready.ops.ssilk.generate_rig(proxies=4) == {"FINISHED"}
    assert len(ready.data.objects["Gerüst"].data.bones) == 3 + 4


def test_a_garment_that_was_edited_meanwhile_is_told(ready, classified, monkeypatch):
    from blender_addon.operators import rig

    original = rig.GenerateRig.finish

    def edited(self, context, work):
        ready.ops.object.mode_set(mode="EDIT")
        ready.ops.mesh.select_all(action="SELECT")
        ready.ops.mesh.subdivide()
        ready.ops.object.mode_set(mode="OBJECT")
        return original(self, context, work)

    monkeypatch.setattr(rig.GenerateRig, "finish", edited)
    with pytest.raises(RuntimeError, match="'Skirt' had 312 vertices when this began"):
        ready.ops.ssilk.generate_rig(proxies=4)
    assert not proxies_of(ready)
