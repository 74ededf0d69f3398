# SPDX-License-Identifier: Apache-2.0
"""The preflight in Blender: every finding is selected and, where that is safe, repaired."""

from __future__ import annotations

import numpy as np
import pytest

from blender_addon.arrays.findings import Clip, polygons_of, read_findings
from ssilk_core.authoring.preflight.motion import unread_motion
from ssilk_core.scene.assets import Mesh

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from mathutils import Matrix

from blender_addon.motions.keys import curves_of

from .conftest import activate, add_mesh
from .scenes import animate
from .test_panels import drawn


def mesh(name: str, counts: list[int], points: int) -> Mesh:
    faces = np.zeros((sum(counts) - 2 * len(counts), 3), int)
    return Mesh(f"/Character/{name}", np.zeros((points, 3)), faces, np.array(counts), np.zeros(sum(counts), int))


SHIRT = {"Shirt": mesh("Shirt", [4], 4)}


def test_triangles_are_named_by_their_polygons():
    counts = np.array([3, 4, 5])
    assert polygons_of(counts, [0, 1, 2]) == (0, 1)
    assert polygons_of(counts, [1]) == ()
    assert polygons_of(counts, [3, 4, 5]) == (2,)


@pytest.mark.parametrize(("code", "button"), [("penetration", "Push Out"), ("sliver-faces", "Fix")])
def test_findings_speak_of_buttons_in_place_of_options(code, button):
    document = {"severity": "error", "code": code, "prim": "a.usdc:/Character/Shirt", "why": "", "fixable": True,
                "found": "3 (--fix merges 2)", "fix": "--fix repairs it", "elements": "", "indices": []}  # fmt: skip
    (said,) = read_findings([document], "Shirt", SHIRT)
    assert (said.found, said.fix) == (f"3 ({button} merges 2)", f"{button} repairs it")


def test_findings_on_several_bodies_come_apart():
    meshes = {**SHIRT, "Torso": mesh("Torso", [4], 4), "Hand": mesh("Hand", [3, 3], 5)}
    document = {"severity": "warning", "code": "holes", "found": "", "why": "", "fix": "", "fixable": False}
    whole = {**document, "prim": "a.usdc:/Character"}
    rim, faces = (
        {**whole, "elements": "vertices", "indices": [1, 4, 8]}, {**whole, "elements": "faces", "indices": [3]},
    )  # fmt: skip
    own = {**document, "prim": "a.usdc:/Character/Shirt", "elements": "joints", "indices": [0]}
    said = read_findings([rim, faces, own], "Shirt", meshes)
    found = [(finding.prim, finding.elements, finding.indices) for finding in said]
    assert found == [
        ("Torso", "vertices", (1,)),
        ("Hand", "vertices", (0, 4)),
        ("Hand", "polygons", (1,)),
        ("Shirt", "joints", (0,)),
    ]


def test_findings_on_motions_stand_on_the_timeline():
    jump = {"severity": "warning", "code": "root-jumps", "found": "", "why": "", "fix": "", "fixable": False,
            "elements": "frames", "indices": [7, 9]}  # fmt: skip
    clips = {"/takes/a:b/Walk.usdc": Clip("Walk", 100), "run.usdc": Clip("run.usdc")}
    documents = [{**jump, "prim": f"{path}:/Motion"} for path in clips]
    said = read_findings(documents, "Shirt", SHIRT, clips)
    assert [(finding.prim, finding.elements, finding.indices) for finding in said] == [
        ("Walk", "frames", (107, 109)),
        ("run.usdc", "", ()),  # its frames are nowhere to go to
    ]


def test_a_motion_that_cannot_be_read_is_named():
    clips = {"run.usdc": Clip("Run", 1)}
    document = vars(unread_motion("run.usdc", "run.usdc: no skeletal animation."))
    (said,) = read_findings([document], "Shirt", SHIRT, clips)
    assert (said.prim, said.found) == ("Run", "no skeletal animation")


def findings(bpy) -> dict[str, object]:
    return {item.code: item for item in bpy.context.window_manager.ssilk_preflight.findings}


def show(bpy, code: str):
    """Show a finding in the list, as a click does."""
    preflight = bpy.context.window_manager.ssilk_preflight
    preflight.active = [item.code for item in preflight.findings].index(code)
    return preflight.findings[preflight.active]


def spoil(bpy, thing, change) -> None:
    import bmesh

    mesh = bmesh.new()
    mesh.from_mesh(thing.data)
    mesh.verts.ensure_lookup_table()
    mesh.faces.ensure_lookup_table()
    change(mesh)
    mesh.to_mesh(thing.data)
    mesh.free()
    thing.data.update()


def loose_vertex(mesh):
    mesh.verts.new((0.3, 0, 1))


def flipped_faces(mesh):
    for face in list(mesh.faces)[30:34]:
        face.normal_flip()


def turned_inside_out(mesh):
    for face in mesh.faces:
        face.normal_flip()


def cut_open(mesh):
    import bmesh

    bmesh.ops.split_edges(mesh, edges=[edge for edge in mesh.edges if 0.9 < edge.verts[0].co.z < 1.0][:6])


SPOILED = {
    loose_vertex: "isolated-vertices",
    flipped_faces: "inconsistent-winding",
    turned_inside_out: "inside-out",
    cut_open: "duplicate-vertices",
}


@pytest.mark.parametrize("change, code", SPOILED.items(), ids=lambda item: getattr(item, "__name__", item))
def test_what_is_found_is_selected_and_fixed(ready, skirt, change, code):
    size = len(skirt.data.vertices)
    spoil(ready, skirt, change)
    assert ready.ops.ssilk.inspect() == {"FINISHED"}
    item = show(ready, code)
    count, elements = len(item.indices), item.elements
    assert count
    assert ready.ops.ssilk.select_finding() == {"FINISHED"}
    assert (ready.context.mode, ready.context.object) == ("EDIT_MESH", skirt)
    selected = skirt.data.total_vert_sel if elements == "vertices" else skirt.data.total_face_sel
    assert selected == count
    assert ready.ops.ssilk.fix_finding() == {"FINISHED"}
    assert ready.context.mode == "OBJECT"
    assert len(skirt.data.vertices) == size
    activate(ready, skirt)
    ready.ops.ssilk.inspect()
    assert code not in findings(ready)


def test_a_sound_garment_has_nothing_wrong(ready, skirt):
    assert ready.ops.ssilk.inspect() == {"FINISHED"}
    assert {item.severity for item in findings(ready).values()} <= {"info", "warning"}
    assert not {"error"} & {item.severity for item in findings(ready).values()}


def test_fixes_keep_classes_weights_and_shape_keys(ready, skirt):
    skirt.data.attributes.new("ssilk:class", "INT", "POINT").data.foreach_set("value", [1] * 312)
    skirt.vertex_groups.new(name="Hips").add(list(range(312)), 1.0, "REPLACE")
    skirt.shape_key_add(name="Basis")
    skirt.shape_key_add(name="Wide").data[7].co.x += 0.1
    spoil(ready, skirt, flipped_faces)
    ready.ops.ssilk.inspect()
    show(ready, "inconsistent-winding")
    ready.ops.ssilk.fix_finding()
    wide = skirt.data.shape_keys.key_blocks["Wide"]
    assert np.isclose(wide.data[7].co.x - skirt.data.vertices[7].co.x, 0.1)
    assert skirt.data.attributes["ssilk:class"].data[100].value == 1
    assert skirt.vertex_groups["Hips"].weight(100) == 1


@pytest.mark.parametrize("scale", [1, 0.01])
def test_cloth_in_the_body_is_pushed_out_with_its_shape_keys(ready, skirt, scale):
    skirt.data.transform(Matrix.Scale(1 / scale, 4))
    skirt.scale = (scale,) * 3
    ready.context.view_layer.update()
    skirt.shape_key_add(name="Basis")
    skirt.shape_key_add(name="Wide").data[7].co.x += 0.1 / scale
    height = scale * np.array([vertex.co.z for vertex in skirt.data.vertices])
    waist = np.flatnonzero(height > 1.0).tolist()
    for block in (skirt.data.vertices, *(block.data for block in skirt.data.shape_keys.key_blocks)):
        for index in waist:
            block[index].co.x *= 0.148 / 0.165
            block[index].co.y *= 0.148 / 0.165
    ready.ops.ssilk.inspect()
    item = show(ready, "penetration")
    assert set(item.indices) <= set(waist)
    before = [vertex.co.copy() for vertex in skirt.data.vertices]
    from blender_addon.operators.preflight import fixer
    from blender_addon.panels import PreflightPanel

    assert fixer(item) == "ssilk.push_out"
    assert "ssilk.show_heat" not in drawn(PreflightPanel, ready.context)
    ready.ops.ssilk.select_finding()
    assert (ready.context.mode, ready.ops.ssilk.push_out()) == ("EDIT_MESH", {"FINISHED"})
    assert "ssilk.show_heat" in drawn(PreflightPanel, ready.context)
    radius = [scale * np.hypot(*skirt.data.vertices[index].co.xy) for index in waist]
    assert min(radius) > 0.15
    wide = skirt.data.shape_keys.key_blocks["Wide"]
    assert np.isclose(wide.data[7].co.x - skirt.data.vertices[7].co.x, 0.1 / scale)
    assert all(skirt.data.vertices[index].co == before[index] for index in np.flatnonzero(height < 0.8))
    shift = np.array([vertex.co - old for vertex, old in zip(skirt.data.vertices, before)])
    stored = np.array([item.vector for item in skirt.data.attributes["SSILK Displacement"].data])
    np.testing.assert_allclose(stored, shift, atol=1e-6 / scale)
    assert ready.ops.ssilk.show_heat(kind="PUSHED_OUT") == {"FINISHED"}
    assert skirt.ssilk.heat == "PUSHED_OUT" and "SSILK Heat" in skirt.data.color_attributes
    ready.ops.ssilk.inspect()
    assert "penetration" not in findings(ready) and not fixer(show(ready, "inside-margin"))


def test_what_was_not_pushed_out_cannot_be_shown(ready, skirt):
    with pytest.raises(RuntimeError, match="'Skirt' was not pushed out"):
        ready.ops.ssilk.show_heat(kind="PUSHED_OUT")


def test_an_unequal_scale_is_found_and_applied(ready, skirt):
    armature, pillar = ready.data.objects["Rig"], ready.data.objects["Pillar"]
    pillar.parent = armature
    armature.scale = (1, 1, 2)
    ready.context.view_layer.update()
    with pytest.raises(RuntimeError, match="'Rig': its bones are scaled unequally"):
        ready.ops.ssilk.inspect()
    place = pillar.matrix_world.copy()
    tail = armature.matrix_world @ armature.data.bones["Head"].tail_local
    assert show(ready, "unequal-scale").target == "Rig"
    assert ready.ops.ssilk.fix_finding() == {"FINISHED"}
    ready.context.view_layer.update()
    assert tuple(armature.scale) == (1, 1, 1)
    np.testing.assert_allclose(armature.matrix_world @ armature.data.bones["Head"].tail_local, tail, atol=1e-6)
    np.testing.assert_allclose(np.array(pillar.matrix_world), np.array(place), atol=1e-6)


def test_an_animated_armatures_scale_is_left_alone(ready, skirt):
    armature = ready.data.objects["Rig"]
    armature.scale = (1, 1, 2)
    armature.keyframe_insert("location")
    ready.context.view_layer.update()
    with pytest.raises(RuntimeError, match="scaled unequally"):
        ready.ops.ssilk.inspect()
    with pytest.raises(RuntimeError, match="'Rig' is animated"):
        ready.ops.ssilk.fix_finding()
    assert tuple(armature.scale) == (1, 1, 2)


def test_a_modifier_before_the_armature_is_listed(ready, skirt):
    skirt.modifiers.new("Mirror", "MIRROR")
    with pytest.raises(RuntimeError, match="its modifier 'Mirror' gives it parts"):
        ready.ops.ssilk.inspect()
    assert list(findings(ready)) == ["shaping-modifier"]
    with pytest.raises(RuntimeError, match="needs your decision"):
        ready.ops.ssilk.fix_finding()


def test_a_modifier_of_a_body_after_its_bones_is_listed(ready, skirt):
    from blender_addon.quality.checks import look_again

    modifiers = ready.data.objects["Pillar"].modifiers
    modifiers.new("Late", "SMOOTH")
    assert ready.ops.ssilk.inspect() == {"FINISHED"}
    found = findings(ready)["unmet-modifier"]
    assert (found.target, found.found) == ("Pillar", "its modifier 'Late' comes after its bones")
    modifiers.move(1, 0)
    assert look_again(ready.context.window_manager.ssilk_preflight)
    assert "unmet-modifier" not in findings(ready)


def test_joints_are_selected_as_bones(ready, skirt):
    from blender_addon.settings.preflight import keep_findings
    from ssilk_core.authoring.preflight.finding import Finding

    finding = Finding(severity="info", code="still", prim="", found="", elements="joints", indices=(1,))
    keep_findings(ready.context, "Skirt", [finding])
    assert ready.ops.ssilk.select_finding() == {"FINISHED"}
    armature = ready.data.objects["Rig"]
    assert ready.context.mode == "POSE"
    chosen = [bone.name for bone in armature.pose.bones if (bone if hasattr(bone, "select") else bone.bone).select]
    assert chosen == ["Spine"]


def test_a_mesh_that_changed_since_is_not_touched(ready, skirt):
    spoil(ready, skirt, loose_vertex)
    ready.ops.ssilk.inspect()
    show(ready, "isolated-vertices")
    spoil(ready, skirt, loose_vertex)
    for operator in (ready.ops.ssilk.fix_finding, ready.ops.ssilk.select_finding):
        with pytest.raises(RuntimeError, match="'Skirt' has changed since it was inspected"):
            operator()
    skirt.name = "Rock"
    with pytest.raises(RuntimeError, match="'Skirt' was deleted or renamed"):
        ready.ops.ssilk.fix_finding()


def test_a_fix_is_undone(ready, skirt):
    spoil(ready, skirt, loose_vertex)
    ready.ops.ssilk.inspect()
    ready.ops.ed.undo_push(message="before")
    show(ready, "isolated-vertices")
    ready.ops.ssilk.fix_finding()
    ready.ops.ed.undo_push(message="after")
    assert len(ready.data.objects["Skirt"].data.vertices) == 312
    ready.ops.ed.undo()
    assert len(ready.data.objects["Skirt"].data.vertices) == 313


def test_the_panel_lists_findings_with_their_buttons(ready, skirt):
    from blender_addon.panels.base import lines
    from blender_addon.panels.preflight import PreflightPanel, line

    assert drawn(PreflightPanel, ready.context) == ["ssilk.inspect"]
    spoil(ready, skirt, loose_vertex)
    ready.ops.ssilk.inspect()
    item = show(ready, "isolated-vertices")
    notes = drawn(PreflightPanel, ready.context)
    assert {"ssilk.inspect", "ssilk.select_finding", "ssilk.fix_finding", "findings", "Skirt"} <= set(notes)
    assert line(item) == "1 isolated vertex"
    assert lines("one two three four five", 200) == ["one two three four", "five"]


def told(code: str, elements: str, indices: list[int]) -> str:
    from types import SimpleNamespace

    from blender_addon.panels.preflight import line

    return line(SimpleNamespace(code=code, elements=elements, indices=indices))


def test_findings_are_counted_in_words():
    assert told("penetration", "vertices", list(range(1200))) == "penetration: 1,200 vertices"
    assert told("sliver-faces", "polygons", [1]) == "1 sliver face"
    assert told("duplicate-vertices", "vertices", [1, 2]) == "2 duplicate vertices"
    assert told("rest-pose", "", []) == "rest pose"


def test_each_body_is_told_its_own_holes():
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
    quad = Mesh("/Character/Torso", corners, np.array([[0, 1, 2], [0, 2, 3]]), np.array([4]), np.arange(4))
    triangle = Mesh("/Character/Hand", corners[:3], np.array([[0, 1, 2]]), np.array([3]), np.arange(3))
    document = {"severity": "warning", "code": "body-not-watertight", "prim": "a.usdc:/Character", "why": "",
                "found": "the body is open along 7 edges", "fix": "", "fixable": False, "elements": "vertices",
                "indices": list(range(7))}  # fmt: skip
    found = read_findings([document], "Shirt", {**SHIRT, "Torso": quad, "Hand": triangle})
    assert [(each.prim, each.found) for each in found] == [
        ("Torso", "it is open along 4 edges"), ("Hand", "it is open along 3 edges"),
    ]  # fmt: skip
    other = {**document, "code": "low-poly-body", "indices": [], "elements": ""}
    error = {**other, "severity": "error", "code": "body-inside-out"}
    found = read_findings([document, other, error], "Shirt", {**SHIRT, "Torso": quad})
    assert [each.code for each in found] == ["body-inside-out", "low-poly-body", "body-not-watertight"]


def test_findings_on_others_than_the_garment_name_them():
    from types import SimpleNamespace

    from blender_addon.panels.preflight import named_line

    item = SimpleNamespace(code="body-not-watertight", elements="vertices", indices=[1, 2], target="Torso")
    assert named_line(item, "Shirt") == "Torso: body not watertight: 2 vertices"
    item.target = "Shirt"
    assert named_line(item, "Shirt") == "Body not watertight: 2 vertices"


def test_what_was_mended_by_hand_goes_and_the_rest_says_that_it_is_old(ready, skirt):
    from blender_addon.operators.training import watch
    from blender_addon.panels.preflight import PreflightPanel

    spoil(ready, skirt, loose_vertex)
    spoil(ready, skirt, loose_vertex)
    ready.ops.ssilk.inspect()
    kept = set(findings(ready)) - {"isolated-vertices"}
    watch()
    assert not any(item.old for item in findings(ready).values())
    assert len(show(ready, "isolated-vertices").indices) == 2
    spoil(ready, skirt, lambda mesh: mesh.verts.remove(mesh.verts[-1]))
    watch()
    assert len(show(ready, "isolated-vertices").indices) == 1
    spoil(ready, skirt, lambda mesh: mesh.verts.remove(mesh.verts[-1]))
    watch()
    assert set(findings(ready)) == kept and kept
    old = [item.code for item in findings(ready).values() if item.old]
    assert set(old) == {code for code, item in findings(ready).items() if item.target == "Skirt"}
    mirror = skirt.modifiers.new("Mirror", "MIRROR")
    with pytest.raises(RuntimeError, match="its modifier 'Mirror'"):
        ready.ops.ssilk.inspect()
    skirt.modifiers.remove(mirror)
    watch()
    assert not findings(ready) and drawn(PreflightPanel, ready.context)[-1] == "ssilk.inspect"


def test_a_garment_far_from_the_body_is_an_error(ready, skirt):
    skirt.location.x = 5
    ready.context.view_layer.update()
    ready.ops.ssilk.inspect()
    assert findings(ready)["alignment"].severity == "error"


def test_a_body_inside_out_is_turned(ready, skirt):
    pillar = ready.data.objects["Pillar"]
    spoil(ready, pillar, turned_inside_out)
    ready.ops.ssilk.inspect()
    assert show(ready, "body-inside-out").target == "Pillar"
    ready.ops.ssilk.select_finding()
    assert (ready.context.object, pillar.data.total_face_sel) == (pillar, len(pillar.data.polygons))
    ready.ops.ssilk.fix_finding()
    activate(ready, skirt)
    ready.ops.ssilk.inspect()
    assert "body-inside-out" not in findings(ready)


def test_two_bodies_are_told_apart(ready, skirt):
    extra = add_mesh(ready, "Prop", np.array([[0.0, 0, 2], [0.2, 0, 2], [0, 0.2, 2]]), np.array([[0, 1, 2]]))
    extra.vertex_groups.new(name="Head").add([0, 1, 2], 1.0, "REPLACE")
    extra.modifiers.new("Armature", "ARMATURE").object = ready.data.objects["Rig"]
    activate(ready, skirt)
    ready.ops.ssilk.inspect()
    every = ready.context.window_manager.ssilk_preflight.findings
    items = [item for item in every if item.code == "body-not-watertight"]
    assert {item.target for item in items} == {"Pillar", "Prop"}
    assert [item.indices for item in items if item.target == "Prop"] == [[0, 1, 2]]


def test_chosen_motions_are_inspected_and_gone_to(ready, skirt):
    """An action in which the root jumps is found; one that is not chosen is not looked at."""
    bpy = ready
    assert bpy.ops.ssilk.classify() == {"FINISHED"}
    armature = bpy.data.objects["Rig"]
    animate(bpy, armature, "Calm", 0.1, 40)
    action = animate(bpy, armature, "Leap", 0.1, 40, first=101)
    for curve in curves_of(action):
        if curve.data_path.endswith("location") and curve.array_index == 1:
            for point in curve.keyframe_points:
                point.interpolation = "CONSTANT"
                point.co.y += 5.0 * (point.co.x > 120)
    assert bpy.ops.ssilk.find_motions() == {"FINISHED"}
    motions = {item.name: item for item in skirt.ssilk.training.motions}
    motions["Leap"].use, motions["Calm"].use, motions["Timeline"].use = False, True, False
    assert bpy.ops.ssilk.inspect() == {"FINISHED"}
    assert "root-jumps" not in findings(bpy)
    motions["Leap"].use = True
    assert bpy.ops.ssilk.inspect() == {"FINISHED"}
    item = show(bpy, "root-jumps")
    assert (item.target, item.elements, item.indices) == ("Leap", "frames", [121])
    assert bpy.ops.ssilk.select_finding() == {"FINISHED"} and bpy.context.scene.frame_current == 121
