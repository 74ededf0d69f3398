# SPDX-License-Identifier: Apache-2.0
"""What a shot in USD lacks of a look in Blender is named, each kind of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")


def attribute(thing: Any, name: str, kind: str, domain: str, value: Any) -> None:
    made = thing.data.attributes.new(name, kind, domain)
    made.data.foreach_set("value", [value] * len(made.data))


def solid(thing: Any) -> None:
    thing.modifiers.new("Solid", "SOLIDIFY")
    thing.modifiers.new("Finer", "SUBSURF").show_render = False


def hairy(thing: Any) -> None:
    thing.modifiers.new("Fur", "PARTICLE_SYSTEM")


def property_of_its_own(thing: Any) -> None:
    thing["asset_id"] = "cape_0042"


CASES: dict[str, Callable[[Any], Any]] = {
    "the attribute 'wet'": lambda thing: attribute(thing, "wet", "FLOAT", "POINT", 0.5),
    "the custom property 'asset_id'": property_of_its_own,
    "the modifier 'Solid'": solid,
    "the modifier 'Fur'": hairy,
    "its flat or sharp shading": lambda thing: attribute(thing, "sharp_edge", "BOOLEAN", "EDGE", True),
    "its creases": lambda thing: attribute(thing, "crease_edge", "FLOAT", "EDGE", 0.7),
}


@pytest.mark.parametrize(("told", "change"), CASES.items(), ids=CASES)
@pytest.mark.parametrize("name", ["Skirt", "Pillar"])
def test_what_a_mesh_loses_is_named(bpy, skirt, name, told, change):
    from blender_addon.scene.look import lost_looks

    thing = bpy.data.objects[name]
    thing.data.shade_smooth()
    thing.data.uv_layers.new(name="UVMap")
    assert lost_looks([thing]) == []
    change(thing)
    assert lost_looks([thing]) == [f"'{name}' loses {told}"]


@pytest.mark.parametrize("name", ["Skirt", "Pillar"])
def test_the_uv_map_that_is_rendered_is_handed_over_whichever_is_edited(bpy, skirt, name):
    import numpy as np

    from blender_addon.scene.gather import read_mesh
    from blender_addon.scene.look import lost_looks

    thing = bpy.data.objects[name]
    thing.data.shade_smooth()
    for place, kind in enumerate(("Bake", "Colour")):
        layer = thing.data.uv_layers.new(name=kind)
        layer.uv.foreach_set("vector", [float(place)] * 2 * len(layer.uv))
    thing.data.uv_layers["Colour"].active_render = True
    thing.data.uv_layers.active = thing.data.uv_layers["Bake"]
    for mesh in (thing.data, thing.evaluated_get(bpy.context.evaluated_depsgraph_get()).data):
        np.testing.assert_array_equal(read_mesh(thing, mesh, "/Mesh").uvs, 1)
    assert lost_looks([thing]) == [f"'{name}' loses the UV map 'Bake'"]


def test_modifiers_that_shape_a_body_before_its_bones_are_not_lost(bpy, skirt):
    from blender_addon.scene.look import lost_looks

    pillar = bpy.data.objects["Pillar"]
    pillar.data.shade_smooth()
    pillar.modifiers.new("Early", "DISPLACE")
    pillar.modifiers.move(1, 0)
    assert lost_looks([pillar]) == []


def test_shading_that_a_modifier_above_the_bones_makes_is_named(bpy, skirt):
    """Smooth by Angle marks edges as sharp, and Weighted Normal turns corners, before bones move the mesh."""
    from blender_addon.scene.look import lost_looks

    pillar = bpy.data.objects["Pillar"]
    pillar.data.shade_smooth()
    pillar.modifiers.new("Weighted", "WEIGHTED_NORMAL")
    pillar.modifiers.move(1, 0)
    assert lost_looks([pillar]) == ["'Pillar' loses its flat or sharp shading"]


def test_what_is_drawn_of_a_character_and_not_written_is_named(bpy, skirt):
    from blender_addon.scene.look import left_behind

    rig, pillar = bpy.data.objects["Rig"], bpy.data.objects["Pillar"]
    assert left_behind(rig, [skirt, pillar]) == ""
    names = ("Belt", "Hat", "Lashes", "Unrendered", "Elsewhere", "Bag")
    for number, name in enumerate(names):
        thing = bpy.data.objects.new(name, bpy.data.curves.new(name, "CURVE"))
        bpy.context.collection.objects.link(thing)
        thing.hide_render = name == "Unrendered"
        if name in ("Belt", "Unrendered"):
            thing.modifiers.new("Armature", "ARMATURE").object = rig
        elif name != "Elsewhere":
            thing.parent = (rig, pillar)[number % 2]
    pillar.parent = rig
    bpy.context.view_layer.update()
    assert left_behind(rig, [skirt, pillar]) == "'Bag', 'Belt', 'Hat' and 1 more of 'Rig'"
