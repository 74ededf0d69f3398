# SPDX-License-Identifier: Apache-2.0
"""The rule about modifiers, for each kind that Blender has, and that everything keeps to it."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from .scenes import animate, shown

FINE, APPLY, REMOVE = "", "apply it", "remove it, or switch it off"
BELOW = "move it below the Armature modifier"
EITHER = f"{APPLY}, or {BELOW}"
# What to do above the Armature modifier, below it, and without one.
RULE = {
    (BELOW, FINE, FINE): "BEVEL DECIMATE EDGE_SPLIT MASK MULTIRES REMESH SOLIDIFY SUBSURF TRIANGULATE WELD WIREFRAME",
    (EITHER, FINE, APPLY): "CAST CORRECTIVE_SMOOTH CURVE DISPLACE HOOK LAPLACIANDEFORM LAPLACIANSMOOTH LATTICE "
    "MESH_DEFORM NODES SHRINKWRAP SIMPLE_DEFORM SMOOTH SURFACE_DEFORM WARP WAVE",
    (APPLY, APPLY, APPLY): "ARRAY BOOLEAN BUILD MIRROR PARTICLE_INSTANCE SCREW SKIN VOLUME_TO_MESH",
    (REMOVE, REMOVE, REMOVE): "CLOTH EXPLODE FLUID MESH_CACHE MESH_SEQUENCE_CACHE OCEAN SOFT_BODY",
    (FINE, FINE, FINE): "COLLISION DATA_TRANSFER DYNAMIC_PAINT NORMAL_EDIT PARTICLE_SYSTEM SURFACE UV_PROJECT "
    "UV_WARP VERTEX_WEIGHT_EDIT VERTEX_WEIGHT_MIX VERTEX_WEIGHT_PROXIMITY WEIGHTED_NORMAL",
}
NOT_FOR_MESHES = ("GREASE_PENCIL", "LINEART", "MESH_TO_VOLUME", "VOLUME_DISPLACE")


def told(garment) -> str:
    """Return what to do about a garment's modifiers, as training, baking and playing say it; empty if nothing."""
    from blender_addon.errors import SetupError
    from blender_addon.scene.modifiers import need_plain_modifiers, objections

    found = objections(garment)
    try:
        need_plain_modifiers(garment)
    except SetupError as error:
        said = f"The modifier '{found[0].modifier}' of '{garment.name}' {found[0].does}; {found[0].todo}."
        assert said == str(error)
    return found[0].todo if found else FINE


def test_each_modifier_is_judged_by_where_it_stands(bpy, skirt):
    every = {item.identifier for item in bpy.types.Modifier.bl_rna.properties["type"].enum_items}
    expected = {kind: todo for todo, kinds in RULE.items() for kind in kinds.split()}
    unjudged = {kind for kind in every - {"ARMATURE", *expected} if not kind.startswith(NOT_FOR_MESHES)}
    assert not unjudged
    rig = bpy.data.objects["Rig"]
    for kind in sorted(every & set(expected)):
        places = []
        for order in (["it", "bones"], ["bones", "it"], ["it"]):
            skirt.modifiers.clear()
            for name in order:
                modifier = skirt.modifiers.new(name, kind if name == "it" else "ARMATURE")
                assert modifier, kind
                if name == "bones":
                    modifier.object = rig
            places.append(told(skirt))
        assert tuple(places) == expected[kind], kind


def test_what_is_off_or_deforms_nothing_is_passed_over(bpy, skirt):
    rig = bpy.data.objects["Rig"]
    cloth = skirt.modifiers.new("Cloth", "CLOTH")
    cloth.show_viewport = False
    assert told(skirt) == REMOVE  # it would be rendered
    cloth.show_render = False
    assert told(skirt) == FINE
    skirt.modifiers.new("Idle", "ARMATURE")
    skirt.modifiers.new("Finer", "SUBSURF")
    skirt.modifiers.new("Bones", "ARMATURE").object = rig
    assert told(skirt) == BELOW
    skirt.modifiers.move(2, 3)
    assert told(skirt) == FINE
    skirt.modifiers.new("Again", "ARMATURE").object = rig
    assert told(skirt) == "remove one of both"


def test_nodes_that_simulate_move_a_garment_by_themselves(bpy, skirt):
    from blender_addon.scene.modifiers import need_plain_modifiers

    skirt.modifiers.new("Armature", "ARMATURE").object = bpy.data.objects["Rig"]
    inner, outer = (bpy.data.node_groups.new(name, "GeometryNodeTree") for name in ("Inner", "Outer"))
    outer.nodes.new("GeometryNodeGroup").node_tree = inner
    modifier = skirt.modifiers.new("Dynamics", "NODES")
    modifier.node_group = outer
    assert told(skirt) == FINE
    start, end = (inner.nodes.new(f"GeometryNodeSimulation{side}") for side in ("Input", "Output"))
    assert start.pair_with_output(end)
    assert told(skirt) == REMOVE
    need_plain_modifiers(skirt, simulated=True)


def test_training_baking_and_playing_say_the_same(bpy, skirt):
    from blender_addon.errors import SetupError
    from blender_addon.playback.bake import need_bakeable
    from blender_addon.scene.armature import read_joints
    from blender_addon.scene.gather import gather

    rig = bpy.data.objects["Rig"]
    skirt.modifiers.new("Armature", "ARMATURE").object = rig
    skirt.modifiers.new("Cloth", "CLOTH")
    said = []
    for check in (lambda: gather(skirt), lambda: need_bakeable(skirt, rig, read_joints(rig, skirt))):
        with pytest.raises(SetupError) as raised:
            check()
        said.append(str(raised.value))
    assert set(said) == {f"The modifier 'Cloth' of 'Skirt' moves it in place of what is trained; {REMOVE}."}


def test_what_bones_may_be_made_of_is_seen_to_move_what_bones_moved(bpy, skirt):
    from blender_addon.errors import SetupError
    from blender_addon.playback.bake import need_bakeable
    from blender_addon.scene.armature import read_joints
    from blender_addon.scene.gather import gather
    from blender_addon.scene.modifiers import need_plain_modifiers

    rig = bpy.data.objects["Rig"]
    skirt.modifiers.new("Armature", "ARMATURE").object = rig
    cloth = skirt.modifiers.new("Cloth", "CLOTH")
    gather(skirt, simulated=True)
    need_bakeable(skirt, rig, read_joints(rig, skirt), simulated=True)
    cloth.show_viewport = False  # it would be rendered, and stay on
    with pytest.raises(SetupError, match=REMOVE):
        need_plain_modifiers(skirt, simulated=True)
    cloth.show_viewport = True
    skirt.modifiers.move(1, 0)
    with pytest.raises(SetupError, match=BELOW):
        need_plain_modifiers(skirt, simulated=True)


@pytest.mark.parametrize("kinds", [["SUBSURF"], ["SOLIDIFY", "SUBSURF"], ["DECIMATE"], ["SMOOTH"]])
def test_the_mesh_beneath_what_refines_it_is_where_bones_move_it(bpy, skirt, kinds):
    from blender_addon.scene.modifiers import cage_points

    rig, pillar = bpy.data.objects["Rig"], bpy.data.objects["Pillar"]
    rig.location, rig.scale = (0.3, -0.2, 0.1), (1.1,) * 3
    pillar.location.x = 0.05
    pillar.shape_key_add(name="Basis")
    pillar.shape_key_add(name="Wide").value = 0.5
    pillar.data.shape_keys.key_blocks["Wide"].data[7].co.x += 0.2
    pillar.vertex_groups["Head"].remove([280])
    animate(bpy, rig, "Walk", 0.3, 9)
    before = shown(bpy, pillar, range(5, 6))[0]
    for kind in kinds:
        modifier = pillar.modifiers.new(kind.title(), kind)
        if kind == "DECIMATE":
            modifier.ratio = 0.5
    found = cage_points(pillar, bpy.context.evaluated_depsgraph_get())
    if kinds == ["SMOOTH"]:
        np.testing.assert_allclose(found, shown(bpy, pillar, range(5, 6))[0], atol=1e-6)
    else:
        np.testing.assert_allclose(found, before, atol=2e-6)


@pytest.mark.parametrize("kind", ["PENETRATION", "STRETCH", "SKIN"])
def test_heat_maps_measure_the_mesh_that_is_refined(bpy, skirt, kind):
    from blender_addon.quality import heat

    def values() -> np.ndarray:
        steps = heat.measuring(skirt, getattr(heat, kind), bpy.context.evaluated_depsgraph_get())
        while True:
            try:
                next(steps)
            except StopIteration as end:
                return end.value.values

    skirt.scale = (0.5, 0.5, 1.0)  # into the pillar
    skirt.ssilk.armature = bpy.data.objects["Rig"]
    bpy.context.view_layer.update()
    plain = values()
    skirt.modifiers.new("Finer", "SUBSURF")
    if kind == "SKIN":
        bpy.data.objects["Pillar"].modifiers.new("Finer", "SUBSURF")
    refined = values()
    assert len(refined) == len(plain)
    np.testing.assert_allclose(refined, plain, atol=1e-6)
