# SPDX-License-Identifier: Apache-2.0
"""Bodies and garments are read in the shape that Blender shows, whatever shape keys make it."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from .conftest import add_mesh, make_meta, tube


def fuller(thing: Any, value: float = 0.0, name: str = "Full", amount: float = 0.2) -> Any:
    """Give an object a shape key that makes it wider, at some value."""
    if not thing.data.shape_keys:
        thing.shape_key_add(name="Basis")
    key = thing.shape_key_add(name=name, from_mix=False)
    for vertex, point in zip(thing.data.vertices, key.data):
        point.co = vertex.co[0] * (1 + amount), vertex.co[1] * (1 + amount), vertex.co[2]
    key.slider_min, key.value = -2.0, value
    return key


def masked(thing: Any) -> None:
    thing.vertex_groups.new(name="Mask").add(list(range(0, len(thing.data.vertices), 2)), 0.5, "REPLACE")
    fuller(thing, 1.0).vertex_group = "Mask"


def pinned(thing: Any) -> None:
    fuller(thing)
    thing.active_shape_key_index, thing.show_only_shape_key = 1, True


def pinned_and_masked(thing: Any) -> None:
    """What is masked out of a pinned key has the shape of the reference key, whatever that is relative to."""
    on_another(thing)
    thing.vertex_groups.new(name="Mask").add(list(range(0, len(thing.data.vertices), 2)), 0.5, "REPLACE")
    thing.data.shape_keys.key_blocks["More"].vertex_group = "Mask"
    thing.active_shape_key_index, thing.show_only_shape_key = 2, True


def masked_by_no_weights(thing: Any) -> None:
    """Blender masks nothing in a mesh whose vertices are in no group."""
    thing.vertex_groups.new(name="Mask")
    fuller(thing, 1.0).vertex_group = "Mask"


def driven(thing: Any) -> None:
    fuller(thing).driver_add("value").driver.expression = "0.8"


def keyed(thing: Any) -> None:
    key = fuller(thing)
    for frame, key.value in ((1, 1.0), (20, 0.2)):
        key.keyframe_insert("value", frame=frame)


def on_another(thing: Any) -> None:
    fuller(thing, name="More", amount=0.4).relative_key = fuller(thing)
    thing.data.shape_keys.key_blocks["More"].value = 0.5


def refined(thing: Any) -> None:
    fuller(thing, 0.7)
    thing.modifiers.new("Smooth", "SUBSURF")


CASES: dict[str, Callable[[Any], Any]] = {
    "on": lambda thing: fuller(thing, 1.0),
    "negative": lambda thing: fuller(thing, -0.5),
    "muted": lambda thing: setattr(fuller(thing, 1.0), "mute", True),
    "masked": masked, "pinned": pinned, "pinned and masked": pinned_and_masked,
    "masked by no weights": masked_by_no_weights, "driven": driven, "keyed": keyed, "on another": on_another,
}  # fmt: skip


def shown_at_rest(bpy, thing) -> np.ndarray:
    """Return where Blender shows vertices at rest [m], y up."""
    rig = bpy.data.objects["Rig"].data
    rig.pose_position = "REST"
    evaluated = thing.evaluated_get(bpy.context.evaluated_depsgraph_get())
    points = np.array([evaluated.matrix_world @ vertex.co for vertex in evaluated.data.vertices])
    rig.pose_position = "POSE"
    return points[:, [0, 2, 1]] * [1, 1, -1]


@pytest.mark.parametrize("name", ["Pillar", "Skirt"])
@pytest.mark.parametrize("change", CASES.values(), ids=CASES)
def test_a_mesh_is_read_in_the_shape_that_blender_shows(ready, skirt, change, name):
    from blender_addon.scene.gather import gather

    thing = ready.data.objects[name]
    change(thing)
    ready.context.scene.frame_set(1)
    scene = gather(skirt, classes=False, proxies=False)
    found = {"Skirt": scene.garment.mesh, "Pillar": scene.character.bodies[0].mesh}[name]
    np.testing.assert_allclose(found.points, shown_at_rest(ready, thing), atol=1e-6)


def test_what_refines_a_body_adds_no_vertices_to_its_shape(ready, skirt):
    from blender_addon.scene.gather import gather

    pillar = ready.data.objects["Pillar"]
    refined(pillar)
    mesh = gather(skirt, classes=False, proxies=False).character.bodies[0].mesh
    pillar.modifiers["Smooth"].show_viewport = False
    np.testing.assert_allclose(mesh.points, shown_at_rest(ready, pillar), atol=1e-6)


@pytest.mark.parametrize("name", ["Pillar", "Skirt"])
def test_absolute_keys_are_refused(ready, skirt, name):
    from blender_addon.errors import SetupError
    from blender_addon.scene.gather import gather

    thing = ready.data.objects[name]
    fuller(thing)
    thing.data.shape_keys.use_relative = False
    with pytest.raises(SetupError, match=f"The shape keys of '{name}' are absolute"):
        gather(skirt)


@pytest.mark.parametrize("change", [keyed, driven])
def test_shapes_that_change_are_told(ready, trained, change):
    from blender_addon.motions.shapes import tell_changing_shapes

    said: list[str] = []
    operator = SimpleNamespace(report=lambda kind, text: said.append(text))
    tell_changing_shapes(operator, trained)
    assert not said
    change(ready.data.objects["Pillar"])
    tell_changing_shapes(operator, trained)
    (told,) = said
    assert told.startswith("The shape key 'Full' of 'Pillar' changes over time, which is not followed")


def said_of(garment) -> list[str]:
    from blender_addon.motions.shapes import tell_changing_shapes

    said: list[str] = []
    tell_changing_shapes(SimpleNamespace(report=lambda kind, text: said.append(text)), garment)
    return said


def test_a_key_that_is_switched_on_later_is_told(ready, trained):
    key = fuller(ready.data.objects["Pillar"], 1.0)
    for frame, key.mute in ((1, True), (20, False)):
        key.keyframe_insert("mute", frame=frame)
    ready.context.scene.frame_set(1)
    (told,) = said_of(trained)
    assert told.startswith("The shape key 'Full' of 'Pillar' changes over time")


def a_muted_driver(thing: Any) -> None:
    curve = fuller(thing, 0.5).driver_add("value")
    curve.driver.expression, curve.mute = "frame", True


def muted_keys(thing: Any) -> None:
    from blender_addon.motions.keys import SLOTS, curves_of

    keyed(thing)
    animation = thing.data.shape_keys.animation_data
    for curve in curves_of(animation.action, animation.action_slot if SLOTS else None):
        curve.mute = True


def strips_that_are_off(thing: Any) -> None:
    keyed(thing)
    animation = thing.data.shape_keys.animation_data
    animation.nla_tracks.new().strips.new("Full", 1, animation.action)
    animation.action, animation.use_nla = None, False


@pytest.mark.parametrize("change", [a_muted_driver, muted_keys, strips_that_are_off])
def test_shapes_whose_animation_is_off_are_not_told(ready, trained, change):
    pillar, values = ready.data.objects["Pillar"], set()
    change(pillar)
    for frame in (1, 10, 20):
        ready.context.scene.frame_set(frame)
        values.add(pillar.data.shape_keys.key_blocks["Full"].value)
    assert len(values) == 1 and not said_of(trained)


@pytest.mark.parametrize("muted", [False, True])
def test_a_key_that_a_meta_strip_moves_is_told(ready, trained, muted):
    pillar = ready.data.objects["Pillar"]
    keyed(pillar)
    animation = pillar.data.shape_keys.animation_data
    animation.nla_tracks.new().strips.new("Full", 1, animation.action)
    animation.action = None
    make_meta(ready, pillar, animation)
    animation.nla_tracks[0].strips[0].mute = muted
    assert bool(said_of(trained)) is not muted


def displaced(bpy: Any, pillar: Any) -> None:
    early = pillar.modifiers.new("Early", "DISPLACE")
    for frame, early.strength in ((1, 0.0), (20, 0.1)):
        early.keyframe_insert("strength", frame=frame)


def waving(bpy: Any, pillar: Any) -> None:
    pillar.modifiers.new("Early", "WAVE")


def hooked(bpy: Any, pillar: Any) -> None:
    hook = bpy.data.objects.new("Hook", None)
    bpy.context.collection.objects.link(hook)
    early = pillar.modifiers.new("Early", "HOOK")
    early.object = hook
    early.vertex_indices_set(list(range(20)))
    for frame, hook.location.x in ((1, 0.0), (20, 0.2)):
        hook.keyframe_insert("location", frame=frame)


def timed_by_nodes(bpy: Any, pillar: Any) -> None:
    tree = bpy.data.node_groups.new("Breathing", "GeometryNodeTree")
    for direction in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
    begin, move, clock, end = map(
        tree.nodes.new,
        ("NodeGroupInput", "GeometryNodeSetPosition", "GeometryNodeInputSceneTime", "NodeGroupOutput"),
    )
    tree.links.new(begin.outputs[0], move.inputs["Geometry"])
    tree.links.new(clock.outputs["Seconds"], move.inputs["Offset"])
    tree.links.new(move.outputs[0], end.inputs[0])
    pillar.modifiers.new("Early", "NODES").node_group = tree


@pytest.mark.parametrize("change", [displaced, waving, hooked, timed_by_nodes])
def test_a_body_whose_modifiers_change_its_shape_is_told(ready, trained, change):
    pillar, scene = ready.data.objects["Pillar"], ready.context.scene
    count = len(ready.data.objects)
    change(ready, pillar)
    others = len(ready.data.objects) - count
    pillar.modifiers.move(len(pillar.modifiers) - 1, 0)
    scene.frame_set(7)
    (told,) = said_of(trained)
    assert told == (
        "Modifiers change the shape of 'Pillar' over time, which is not followed; the shape of frame 7 is met "
        "throughout."
    )
    assert scene.frame_current == 7 and len(ready.data.objects) == count + others  # nothing is left behind


def test_a_body_whose_modifiers_keep_its_shape_is_not_told(ready, trained):
    pillar = ready.data.objects["Pillar"]
    pillar.modifiers.new("Early", "DISPLACE").strength = 0.05
    pillar.modifiers.move(len(pillar.modifiers) - 1, 0)
    assert not said_of(trained)  # though its bones move, which come after


def test_an_armature_modifier_without_armature_is_passed_over(ready, skirt):
    from blender_addon.scene.gather import gather
    from blender_addon.scene.modifiers import unmet_modifiers

    pillar = ready.data.objects["Pillar"]
    pillar.modifiers.new("Empty", "ARMATURE")
    pillar.modifiers.new("Early", "DISPLACE").strength = 0.05
    for _ in range(2):
        pillar.modifiers.move(len(pillar.modifiers) - 1, 0)
    pillar.modifiers.move(pillar.modifiers.find("Empty"), 0)
    assert [each.name for each in pillar.modifiers] == ["Empty", "Early", "Armature"]
    mesh = gather(skirt, classes=False, proxies=False).character.bodies[0].mesh
    np.testing.assert_allclose(mesh.points, shown_at_rest(ready, pillar), atol=1e-6)
    assert unmet_modifiers(pillar) == []


@pytest.mark.parametrize("kind", ["MIRROR", "SMOOTH", "DISPLACE"])
def test_what_shapes_a_body_after_its_bones_is_told(ready, trained, kind):
    pillar = ready.data.objects["Pillar"]
    pillar.modifiers.new("Late", kind)
    (told,) = said_of(trained)
    assert told.startswith("The modifier 'Late' of 'Pillar' comes after its bones; cloth meets the body")
    pillar.modifiers.move(len(pillar.modifiers) - 1, 0)
    assert not said_of(trained)


def test_shapes_that_only_could_change_are_not_told(ready, skirt):
    from blender_addon.motions.shapes import changing_shapes

    key = fuller(skirt, 1.0)
    for frame in (1, 20):
        key.keyframe_insert("value", frame=frame)
    assert changing_shapes(skirt) == []  # one value throughout
    key.value = 0.2
    key.keyframe_insert("value", frame=20)
    assert changing_shapes(skirt) == ["Full"]
    skirt.show_only_shape_key = True
    assert changing_shapes(skirt) == []
    skirt.show_only_shape_key = False
    animation = skirt.data.shape_keys.animation_data
    track = animation.nla_tracks.new()
    track.strips.new("Strip", 1, animation.action)
    animation.action = None
    assert changing_shapes(skirt) == ["Full"]
    track.mute = True
    assert changing_shapes(skirt) == []


def test_a_mesh_is_another_once_its_keys_shape_it_otherwise(ready, skirt):
    """By this mark findings of the preflight are looked at again."""
    from blender_addon.quality.checks import mark_of

    key, marks = fuller(skirt), [mark_of("Skirt")]
    fuller(skirt, 0.7, "SSILK 1")  # a bake is no other shape
    assert mark_of("Skirt") == marks[0]
    key.value = 1.0
    marks.append(mark_of("Skirt"))
    key.data[0].co.x += 0.1
    marks.append(mark_of("Skirt"))
    skirt.active_shape_key_index, skirt.show_only_shape_key = 0, True
    marks.append(mark_of("Skirt"))
    assert len(set(marks)) == 4


def test_groups_that_mask_keys_are_read_once(ready, skirt, monkeypatch):
    """For each key, a face of forty keys and 50,000 vertices took five seconds, and a bake three minutes."""
    from blender_addon.scene import shapes

    read: list[object] = []
    own = shapes.read_groups
    monkeypatch.setattr(shapes, "read_groups", lambda *args: read.append(args) or own(*args))
    masked(skirt)
    fuller(skirt, 0.5, "More").vertex_group = "Mask"
    assert len(shapes.earlier_shapes(skirt)) == 3 and len(read) == 1


def test_an_lbs_copy_of_absolute_keys_leaves_nothing_behind(ready, trained):
    from blender_addon.errors import SetupError
    from blender_addon.quality.lbs_copy import show_copy

    fuller(trained)
    trained.data.shape_keys.use_relative = False
    before = {thing.name for thing in (*ready.data.objects, *ready.data.meshes)}
    with pytest.raises(SetupError, match="are absolute"):
        show_copy(trained)
    assert {thing.name for thing in (*ready.data.objects, *ready.data.meshes)} == before


def test_keys_that_correct_a_bake_come_after_the_shape_that_was_trained(ready, skirt):
    from blender_addon.scene.shapes import earlier_shapes, worn_points

    fuller(skirt, 1.0)
    trained = worn_points(skirt)
    fuller(skirt, 0.5, "Fix")
    shapes = list(earlier_shapes(skirt))
    np.testing.assert_array_equal(shapes[0], worn_points(skirt))
    np.testing.assert_array_equal(shapes[1], trained)
    assert np.abs(shapes[0] - trained).max() > 0.01


def test_a_garment_that_was_trained_in_a_shape_is_baked_in_no_other(ready, trained):
    fuller(trained, 1.0)
    ready.context.scene.frame_end = 4
    assert ready.ops.ssilk.bake(pre_roll=0.0) == {"FINISHED"}  # a key of later, which corrects the bake
    reference = trained.data.shape_keys.reference_key
    for point in reference.data:
        point.co.x *= 1.2
    with pytest.raises(RuntimeError, match="has another shape or place at rest than when it was trained"):
        ready.ops.ssilk.bake(pre_roll=0.0)


def test_a_body_in_another_shape_than_in_training_is_told(ready, trained, folder):
    """The armature may stand elsewhere meanwhile, and the body with it."""
    from blender_addon.playback.bodies import reshaped
    from blender_addon.scene.armature import read_joints
    from blender_addon.scene.gather import gather
    from blender_addon.scene.handover import STAGE, hand_over
    from blender_addon.scene.objects import Pair

    rig, pillar = ready.data.objects["Rig"], ready.data.objects["Pillar"]
    (folder / "given").mkdir()
    hand_over(gather(trained), Pair.of(trained, rig), folder / "given")
    for thing in (rig, pillar, trained):
        thing.location.x += 3.0
    ready.context.view_layer.update()
    joints = read_joints(rig, trained).character
    assert reshaped(trained, joints, folder / "given" / STAGE) == ""
    swollen = pillar.modifiers.new("Early", "DISPLACE")
    swollen.strength, swollen.mid_level = 0.02, 0.0
    pillar.modifiers.move(len(pillar.modifiers) - 1, 0)
    assert "'Pillar' is up to 20 mm off" in reshaped(trained, joints, folder / "given" / STAGE)
    pillar.modifiers.remove(swollen)
    fuller(pillar, 1.0)
    found = reshaped(trained, joints, folder / "given" / STAGE)
    assert found == " ('Pillar' is up to 30 mm off its shape in training, which the cloth met)"


def test_the_bake_of_a_body_is_no_other_shape_of_it(ready, trained, folder):
    from blender_addon.playback.bodies import reshaped
    from blender_addon.scene.armature import read_joints
    from blender_addon.scene.gather import gather
    from blender_addon.scene.handover import STAGE, hand_over
    from blender_addon.scene.objects import Pair

    rig, pillar = ready.data.objects["Rig"], ready.data.objects["Pillar"]
    (folder / "renamed").mkdir()
    hand_over(gather(trained), Pair.of(trained, rig), folder / "renamed")
    trained.name = "Gown"  # the body is found all the same
    joints = read_joints(rig, trained).character
    fuller(pillar, 1.0, "SSILK 1")  # as where it is another garment
    assert reshaped(trained, joints, folder / "renamed" / STAGE) == ""
    fuller(pillar, 1.0)
    assert "'Pillar' is up to 30 mm off" in reshaped(trained, joints, folder / "renamed" / STAGE)


def test_a_driven_key_of_a_character_that_was_just_linked_counts(ready, skirt, tmp_path):
    from blender_addon.scene.gather import gather

    rig, pillar, path = ready.data.objects["Rig"], ready.data.objects["Pillar"], str(tmp_path / "char.blend")
    rig["fat"] = 0.7
    driver = fuller(pillar).driver_add("value").driver
    variable = driver.variables.new()
    variable.targets[0].id, variable.targets[0].data_path, driver.expression = rig, '["fat"]', variable.name
    ready.data.libraries.write(path, {rig, pillar})
    ready.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    with ready.data.libraries.load(path, link=True) as (_, wanted):
        wanted.objects = ["Rig", "Pillar"]
    for thing in wanted.objects:
        ready.context.collection.objects.link(thing)
    garment = add_mesh(ready, "Skirt", *tube(24, 13, (0.6, 1.0, 1.3), (0.5, 0.165, 0.165)))
    garment.ssilk.armature = wanted.objects[0]
    mesh = gather(garment, classes=False, proxies=False).character.bodies[0].mesh
    np.testing.assert_allclose(mesh.points, shown_at_rest(ready, wanted.objects[1]), atol=1e-6)
    assert np.hypot(*mesh.points[:, [0, 2]].T).max() > 0.15 * 1.1  # it is on
