# SPDX-License-Identifier: Apache-2.0
"""What cloth does not meet is told: what else than bones moves a body, shapes it, or stands for one."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from .conftest import activate, add_armature, add_mesh, tube
from .scenes import animate
from .test_shapes import fuller, shown_at_rest


@pytest.fixture
def moving(bpy, skirt) -> Any:
    """The skirt, chosen to be the animated pillar's."""
    skirt.ssilk.armature = bpy.data.objects["Rig"]
    animate(bpy, skirt.ssilk.armature, "Walk", 0.4, 20)
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = 1, 20
    bpy.context.scene.frame_set(1)
    return skirt


def said_of(garment: Any, *motions: Any) -> list[str]:
    import bpy

    from blender_addon.motions.shapes import tell_changing_shapes

    said: list[str] = []
    bpy.context.view_layer.update()
    tell_changing_shapes(SimpleNamespace(report=lambda kind, text: said.append(text)), garment, motions)
    return said


def again(bpy: Any, pillar: Any) -> None:
    pillar.modifiers.new("Again", "ARMATURE").object = bpy.data.objects["Rig"]


def again_below_what_refines(bpy: Any, pillar: Any) -> None:
    pillar.modifiers.new("Finer", "SUBSURF")
    again(bpy, pillar)


def by_a_face_rig(bpy: Any, pillar: Any) -> None:
    face = add_armature(bpy)
    animate(bpy, face, "Face", 0.2, 20)
    pillar.modifiers.new("Face", "ARMATURE").object = face


def by_envelopes(bpy: Any, pillar: Any) -> None:
    for bone in bpy.data.objects["Rig"].data.bones:
        pillar.vertex_groups[bone.name].add(range(len(pillar.data.vertices)), 0.5, "REPLACE")
        bone.use_envelope_multiply = True


def not_at_all(bpy: Any, pillar: Any) -> None:
    pillar.modifiers["Armature"].show_viewport = False


def as_an_object(bpy: Any, pillar: Any) -> None:
    for frame, pillar.location.x in ((1, 0.0), (20, 0.3)):
        pillar.keyframe_insert("location", frame=frame)


def by_a_bone_too(bpy: Any, pillar: Any) -> None:
    pillar.parent, pillar.parent_type, pillar.parent_bone = bpy.data.objects["Rig"], "BONE", "Hips"


MOVED = (again, again_below_what_refines, by_a_face_rig, by_envelopes, not_at_all, as_an_object, by_a_bone_too)


@pytest.mark.parametrize("change", MOVED)
def test_a_body_that_something_else_moves_too_is_told(bpy, moving, change):
    pillar = bpy.data.objects["Pillar"]
    assert not said_of(moving)
    change(bpy, pillar)
    count = len(bpy.data.objects)
    (told,) = said_of(moving)
    assert told.startswith("Blender shows 'Pillar' up to ")
    assert "from where the bones of 'Rig' move it (frame " in told and len(bpy.data.objects) == count


def test_a_body_is_looked_at_in_the_motions_that_are_chosen(bpy, moving):
    from blender_addon.motions.sources import ACTION, Source

    again(bpy, bpy.data.objects["Pillar"])
    moving.ssilk.armature.animation_data.action = None
    for bone in moving.ssilk.armature.pose.bones:
        bone.matrix_basis.identity()
    assert not said_of(moving)  # it stands at rest
    (told,) = said_of(moving, Source(ACTION, "Walk"))
    assert "of 'Walk')" in told and moving.ssilk.armature.animation_data.action is None


def test_what_bones_carry_and_keys_move_is_told(bpy, moving):
    pad = add_mesh(bpy, "Pad", *tube(16, 5, (1.2, 1.4), (0.2, 0.2)))
    pad.parent, pad.parent_type, pad.parent_bone = moving.ssilk.armature, "BONE", "Spine"
    bodies = bpy.data.collections.new("Bodies")
    bodies.objects.link(pad)
    moving.ssilk.bodies = bodies
    assert not said_of(moving)
    as_an_object(bpy, pad)
    (told,) = said_of(moving)
    assert told.startswith("Blender shows 'Pad' up to ")


def pulsing(bpy: Any, pillar: Any) -> None:
    """For ten frames of five hundred, between those that are looked at."""
    bpy.context.scene.frame_end = 500
    early = pillar.modifiers.new("Early", "DISPLACE")
    for frame, early.strength in ((20, 0.0), (25, 0.1), (30, 0.0)):
        early.keyframe_insert("strength", frame=frame)


def driven(bpy: Any, pillar: Any) -> None:
    driver = pillar.modifiers.new("Early", "DISPLACE").driver_add("strength").driver
    driver.expression = "0.05"


@pytest.mark.parametrize("change", [pulsing, driven])
def test_keys_and_drivers_of_modifiers_that_shape_a_body_are_told(bpy, moving, change):
    pillar = bpy.data.objects["Pillar"]
    change(bpy, pillar)
    assert not any("over time" in text for text in said_of(moving))  # it comes after the bones
    pillar.modifiers.move(1, 0)
    (told,) = said_of(moving)
    assert told.startswith("Modifiers change the shape of 'Pillar' over time")


@pytest.mark.parametrize("name", ["Pillar", "Skirt"])
def test_an_object_that_its_parent_deforms_is_refused(bpy, moving, name):
    from blender_addon.errors import SetupError
    from blender_addon.scene.gather import gather

    thing = bpy.data.objects[name]
    thing.modifiers.clear()
    thing.parent, thing.parent_type = moving.ssilk.armature, "ARMATURE"
    hat = add_mesh(bpy, "Hat", *tube(16, 5, (1.6, 1.7), (0.2, 0.2)))
    hat.vertex_groups.new(name="Head").add(range(80), 1.0, "REPLACE")
    hat.modifiers.new("Armature", "ARMATURE").object = moving.ssilk.armature
    with pytest.raises(SetupError, match=f"'{name}' is deformed by its parent 'Rig' beside its modifiers"):
        gather(moving, classes=False, proxies=False)


def test_a_body_is_read_with_the_weights_that_modifiers_give_it(bpy, moving):
    from blender_addon.scene.gather import gather

    pillar = bpy.data.objects["Pillar"]
    pillar.vertex_groups.new(name="Other").add(range(len(pillar.data.vertices)), 1.0, "REPLACE")
    mix = pillar.modifiers.new("Mix", "VERTEX_WEIGHT_MIX")
    mix.vertex_group_a, mix.vertex_group_b, mix.mix_set, mix.mix_mode = "Spine", "Other", "ALL", "ADD"
    pillar.modifiers.move(1, 0)
    plain = gather(moving, classes=False, proxies=False).character.bodies[0].skin.dense(3)
    assert plain[:, 1].min() > 0.4
    assert not said_of(moving)


@pytest.mark.parametrize(("group", "refused"), [("Spine", True), ("Folds", False)])
def test_a_garment_whose_weights_a_modifier_changes_is_refused(bpy, moving, group, refused):
    from blender_addon.scene.modifiers import objections

    moving.vertex_groups.new(name=group)
    early = moving.modifiers.new("Early", "VERTEX_WEIGHT_EDIT")
    early.vertex_group = group
    moving.modifiers.new("Bones", "ARMATURE").object = moving.ssilk.armature
    found = [(each.modifier, each.does) for each in objections(moving)]
    assert found == ([("Early", "changes its weights before bones use them")] if refused else [])
    moving.modifiers.move(1, 0)
    assert not objections(moving)


def test_a_garment_that_takes_its_weights_from_the_body_over_and_over_is_refused(bpy, moving):
    from blender_addon.errors import SetupError
    from blender_addon.scene.gather import gather

    transfer = moving.modifiers.new("Transfer", "DATA_TRANSFER")
    moving.modifiers.new("Bones", "ARMATURE").object = moving.ssilk.armature
    gather(moving, classes=False, proxies=False)
    transfer.use_vert_data, transfer.data_types_verts = True, {"VGROUP_WEIGHTS"}
    with pytest.raises(SetupError, match="'Transfer' of 'Skirt' changes its weights before bones use them; apply it"):
        gather(moving, classes=False, proxies=False)


def disabled(bpy: Any, pillar: Any) -> None:
    pillar.hide_viewport = True


def in_a_disabled_collection(bpy: Any, pillar: Any) -> None:
    group = bpy.data.collections.new("Hidden")
    bpy.context.scene.collection.children.link(group)
    bpy.context.scene.collection.objects.unlink(pillar)
    group.objects.link(pillar)
    group.hide_viewport = True


@pytest.mark.parametrize("hide", [disabled, in_a_disabled_collection])
@pytest.mark.parametrize("by", ["modifier", "driver"])
def test_a_body_that_is_disabled_has_the_shape_that_it_shows_when_it_is_not(bpy, moving, hide, by):
    from blender_addon.scene.gather import gather

    rig, pillar = bpy.data.objects["Rig"], bpy.data.objects["Pillar"]
    hide(bpy, pillar)
    if by == "modifier":
        pillar.modifiers.new("Early", "DISPLACE").strength = 0.05
        pillar.modifiers.move(1, 0)
    else:
        rig["fat"] = 0.6
        rig.update_tag()
        driver = fuller(pillar).driver_add("value").driver
        variable = driver.variables.new()
        variable.targets[0].id, variable.targets[0].data_path, driver.expression = rig, '["fat"]', variable.name
    groups = list(pillar.users_collection)
    mesh = gather(moving, classes=False, proxies=False).character.bodies[0].mesh
    assert list(pillar.users_collection) == groups and pillar.hide_viewport == (hide is disabled)
    pillar.hide_viewport = groups[0].hide_viewport = False
    np.testing.assert_allclose(mesh.points, shown_at_rest(bpy, pillar), atol=1e-6)
    assert np.hypot(*mesh.points[:, [0, 2]].T).max() > 0.16


@pytest.mark.parametrize("chosen", [False, True])
def test_a_belt_that_is_a_curve_is_told(bpy, moving, chosen):
    curve = bpy.data.curves.new("Belt", "CURVE")
    curve.dimensions, curve.bevel_depth = "3D", 0.03
    curve.splines.new("POLY").points.add(5)
    belt = bpy.data.objects.new("Belt", curve)
    bodies = bpy.data.collections.new("Bodies")
    bpy.context.scene.collection.children.link(bodies)
    bodies.objects.link(belt)
    assert not said_of(moving)  # nothing says that it is a body
    if chosen:
        bodies.objects.link(bpy.data.objects["Pillar"])
        moving.ssilk.bodies = bodies
    else:
        belt.modifiers.new("Armature", "ARMATURE").object = moving.ssilk.armature
    (told,) = said_of(moving)
    assert told == "'Belt' is no mesh, and cloth does not meet it; convert it (Object > Convert)."


def test_an_instance_among_the_bodies_is_told(bpy, moving):
    bodies = bpy.data.collections.new("Bodies")
    bpy.context.scene.collection.children.link(bodies)
    shield = bpy.data.objects.new("Shield", None)
    shield.instance_type, shield.instance_collection = "COLLECTION", bpy.data.collections.new("Prop")
    for thing in (shield, bpy.data.objects["Pillar"]):
        bodies.objects.link(thing)
    moving.ssilk.bodies = bodies
    (told,) = said_of(moving)
    assert told.startswith("'Shield' is an instance of a collection, and cloth does not meet it")


def test_a_body_whose_shape_renders_show_otherwise_is_told(bpy, moving):
    pillar = bpy.data.objects["Pillar"]
    early = pillar.modifiers.new("Early", "DISPLACE")
    early.strength = 0.05
    pillar.modifiers.move(1, 0)
    assert not said_of(moving)
    early.show_viewport = False
    (told,) = said_of(moving)
    assert told == (
        "The modifier 'Early' of 'Pillar' is switched on in viewports or in renders alone; cloth meets the body as "
        "viewports show it."
    )


def thicker(bpy: Any, pillar: Any) -> Any:
    late = pillar.modifiers.new("Finer", "SOLIDIFY")
    late.offset, late.thickness = 1.0, 0.02
    return late


def sculpted(bpy: Any, pillar: Any) -> Any:
    """Give a pillar a Multiresolution modifier in which it is 20 mm thicker."""
    multires = pillar.modifiers.new("Finer", "MULTIRES")
    activate(bpy, pillar)
    for _ in range(2):
        assert bpy.ops.object.multires_subdivide(modifier="Finer") == {"FINISHED"}
    pillar.modifiers["Armature"].show_viewport = False
    shown = pillar.evaluated_get(bpy.context.evaluated_depsgraph_get())
    sculpt = bpy.data.objects.new("Sculpt", bpy.data.meshes.new_from_object(shown))
    bpy.context.collection.objects.link(sculpt)
    for vertex in sculpt.data.vertices:
        radius = vertex.co.xy.length
        vertex.co.xy *= (radius + 0.02) / radius if radius else 1
    sculpt.select_set(True)
    assert bpy.ops.object.multires_reshape(modifier="Finer") == {"FINISHED"}
    bpy.data.objects.remove(sculpt)
    pillar.modifiers["Armature"].show_viewport = True
    return multires


@pytest.mark.parametrize("change", [thicker, sculpted])
@pytest.mark.parametrize("where", ["below", "in renders alone", "above", "above, at another level"])
def test_a_body_that_is_refined_outwards_is_told(bpy, moving, change, where):
    pillar = bpy.data.objects["Pillar"]
    refining = change(bpy, pillar)
    bpy.data.objects["Rig"].animation_data_clear()
    for bone in bpy.data.objects["Rig"].pose.bones:
        bone.matrix_basis.identity()
    radius = np.linalg.norm(shown_at_rest(bpy, pillar)[:, [0, 2]], axis=1).max()
    if where == "in renders alone":
        refining.show_viewport = False
    elif where.startswith("above"):
        pillar.modifiers.move(1, 0)
    if where == "above, at another level" and change is sculpted:
        refining.levels = 0
    elif where.startswith("above"):
        assert not said_of(moving)  # cloth meets it as it is seen
        return
    (told,) = said_of(moving)
    found = float(re.search(r"^Renders show 'Pillar' up to ([0-9.]+) mm outside of what cloth meets, ", told)[1])
    assert radius - 0.151 < found / 1000 < radius - 0.147  # from the pillar's edges, or the middle of its faces
    assert found > 12 and "by its modifier 'Finer'. Move" in told


@pytest.mark.parametrize(
    "kind", ["BEVEL", "DECIMATE", "EDGE_SPLIT", "MASK", "SOLIDIFY", "SUBSURF", "TRIANGULATE", "WELD"]
)
def test_a_body_that_is_refined_where_it_is_is_not_told(bpy, moving, kind):
    bpy.data.objects["Pillar"].modifiers.new("Finer", kind)
    assert not said_of(moving)


def bound_fine_mesh(bpy, cage) -> Any:
    """A finer mesh that a bound Surface Deform moves as its cage."""
    fine = add_mesh(bpy, "Fine", *tube(32, 30, (0.02, 1.68), (0.2, 0.2)))
    fine.modifiers.new("Follow", "SURFACE_DEFORM").target = cage
    activate(bpy, fine)
    bpy.context.view_layer.update()
    assert bpy.ops.object.surfacedeform_bind(modifier="Follow") == {"FINISHED"} and fine.modifiers[0].is_bound
    return fine


def test_a_body_that_follows_a_cage_is_told(bpy, moving):
    pillar = bpy.data.objects["Pillar"]
    fine = bound_fine_mesh(bpy, pillar)
    (told,) = said_of(moving)
    assert told.startswith("'Fine' follows 'Pillar' by its modifier 'Follow', and cloth does not meet it; if it is")
    fine.hide_render = True
    assert not said_of(moving)
    fine.hide_render, moving.ssilk.bodies = False, bpy.data.collections.new("Bodies")
    moving.ssilk.bodies.objects.link(pillar)
    assert not said_of(moving)  # the artist has said what cloth meets


def test_a_cage_that_is_not_rendered_is_told(bpy, moving):
    cage = bpy.data.objects["Pillar"].copy()
    cage.name, cage.hide_render = "Cage", True
    bpy.context.collection.objects.link(cage)
    (told,) = said_of(moving)
    assert told.startswith("'Cage' is not rendered, and cloth meets it all the same")
    bodies = bpy.data.collections.new("Bodies")
    bodies.objects.link(cage)
    moving.ssilk.bodies = bodies
    assert not said_of(moving)  # it was chosen


def test_a_body_that_is_being_edited_is_refused(bpy, moving):
    from blender_addon.errors import SetupError
    from blender_addon.scene.gather import gather

    activate(bpy, bpy.data.objects["Pillar"])
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.context.view_layer.objects.active = moving
    for use in (lambda: gather(moving, classes=False, proxies=False), lambda: said_of(moving)):
        with pytest.raises(SetupError, match="'Pillar' is in Edit Mode; leave it first"):
            use()


@pytest.mark.parametrize("hide", [disabled, in_a_disabled_collection])
@pytest.mark.parametrize("kind", ["PENETRATION", "SKIN"])
def test_heat_maps_refuse_a_body_that_blender_does_not_move(bpy, moving, hide, kind):
    from blender_addon.errors import SetupError
    from blender_addon.quality import heat

    list(heat.measuring(moving, getattr(heat, kind), bpy.context.evaluated_depsgraph_get()))
    hide(bpy, bpy.data.objects["Pillar"])
    with pytest.raises(
        SetupError, match="'Pillar' is disabled in viewports, and Blender does not move it; enable it"
    ):
        list(heat.measuring(moving, getattr(heat, kind), bpy.context.evaluated_depsgraph_get()))
