# SPDX-License-Identifier: Apache-2.0
"""Classes painted, filled, mirrored, edited, undone and saved in Blender."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from blender_addon.arrays import classes as palette

from .conftest import activate, add_mesh


def classes_of(thing) -> list[int]:
    values = np.empty(len(thing.data.vertices), dtype=np.int32)
    thing.data.attributes[palette.ATTRIBUTE].data.foreach_get("value", values)
    return values.tolist()


def colors_of(thing) -> np.ndarray:
    layer = thing.data.color_attributes[palette.COLOR_ATTRIBUTE]
    colors = np.empty(len(layer.data) * 4, dtype=np.float32)
    layer.data.foreach_get("color_srgb", colors)
    return colors.reshape(-1, 4)


def paint(thing, vertices, color) -> None:
    """Paint as brushes do: colours alone, none of them pure."""
    layer = thing.data.color_attributes[palette.COLOR_ATTRIBUTE]
    for vertex in vertices:
        layer.data[vertex].color_srgb = (*color, 1.0)


@pytest.fixture
def quad(bpy):
    """Four vertices at x = -1, 1, 1, -1."""
    points = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    thing = add_mesh(bpy, "Quad", points, np.array([[0, 1, 2, 3]]))
    activate(bpy, thing)
    return thing


def test_painting_starts_tight_with_a_palette(bpy, quad):
    assert bpy.ops.ssilk.paint_classes() == {"FINISHED"}
    assert (bpy.context.mode, classes_of(quad)) == ("PAINT_VERTEX", [1, 1, 1, 1])
    assert quad.data.color_attributes.active_color.name == palette.COLOR_ATTRIBUTE
    offered = bpy.context.tool_settings.vertex_paint.palette
    assert [tuple(color.color) for color in offered.colors] == [(0, 0, 0), (1, 0, 0), (0, 1, 0)]


@pytest.mark.parametrize("value, number", [("PINNED", 0), ("TIGHT", 1), ("LOOSE", 2)])
def test_blenders_brush_paints_the_chosen_class(bpy, quad, value, number):
    if bpy.app.version < (4, 5):
        pytest.skip("without a window Blender 4.2 crashes in its own fill")
    bpy.ops.ssilk.paint_classes()
    assert bpy.ops.ssilk.brush_class(value=value) == {"FINISHED"}
    from blender_addon.scene.classes import is_chosen

    assert [is_chosen(bpy.context, color) for color in palette.COLORS] == [number == each for each in range(3)]
    bpy.ops.paint.vertex_color_set()
    bpy.ops.ssilk.take_up_painting()
    assert classes_of(quad) == [number] * 4


def test_blended_colors_become_the_nearest_class_and_pure(bpy, quad):
    bpy.ops.ssilk.paint_classes()
    paint(quad, [0], (0.3, 0.62, 0.1))
    paint(quad, [1], (0.2, 0.1, 0.1))
    assert classes_of(quad) == [1, 1, 1, 1]
    assert bpy.ops.ssilk.take_up_painting() == {"FINISHED"}
    assert classes_of(quad) == [2, 0, 1, 1]
    np.testing.assert_array_equal(colors_of(quad), palette.colors_of(np.array([2, 0, 1, 1])))


def test_painting_again_keeps_what_was_painted(bpy, quad):
    bpy.ops.ssilk.paint_classes()
    paint(quad, [3], (0, 1, 0))
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.ops.ssilk.paint_classes()
    assert classes_of(quad) == [1, 1, 1, 2]


def test_showing_goes_from_classes_to_colors(bpy, quad):
    bpy.ops.ssilk.paint_classes()
    quad.data.attributes[palette.ATTRIBUTE].data.foreach_set("value", [0, 1, 2, 2])
    bpy.ops.ssilk.show_classes()
    np.testing.assert_array_equal(colors_of(quad), palette.colors_of(np.array([0, 1, 2, 2])))


def test_corner_colors_are_taken_up_too(bpy, quad):
    bpy.ops.ssilk.paint_classes()
    paint(quad, [2], (0, 1, 0))
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.ops.geometry.color_attribute_convert(domain="CORNER", data_type="FLOAT_COLOR")
    assert quad.data.color_attributes[palette.COLOR_ATTRIBUTE].domain == "CORNER"
    bpy.ops.ssilk.take_up_painting()
    assert classes_of(quad) == [1, 1, 2, 1]


def select(bpy, thing, vertices) -> None:
    """Select vertices, and be in edit mode."""
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="DESELECT")
    bpy.ops.object.mode_set(mode="OBJECT")
    thing.data.vertices.foreach_set("select", [vertex in vertices for vertex in range(len(thing.data.vertices))])
    bpy.ops.object.mode_set(mode="EDIT")


def test_filling_from_the_selection(bpy, quad):
    select(bpy, quad, [1, 2])
    assert bpy.ops.ssilk.fill_class(value="LOOSE") == {"FINISHED"}
    from blender_addon.panels.classes import class_counts

    assert class_counts(quad) == (0, 2, 2)
    bpy.ops.object.mode_set(mode="OBJECT")
    assert (classes_of(quad), class_counts(quad)) == ([1, 2, 2, 1], (0, 2, 2))


def test_filling_keeps_the_colors_in_step(bpy, quad):
    bpy.ops.ssilk.paint_classes()
    bpy.ops.object.mode_set(mode="OBJECT")
    select(bpy, quad, [0])
    bpy.ops.ssilk.fill_class(value="PINNED")
    bpy.ops.object.mode_set(mode="OBJECT")
    assert classes_of(quad) == palette.nearest(colors_of(quad)).tolist() == [0, 1, 1, 1]


def test_filling_nothing_is_an_error_that_names_the_object(bpy, quad):
    select(bpy, quad, [])
    with pytest.raises(RuntimeError, match="No vertex of 'Quad' is selected"):
        bpy.ops.ssilk.fill_class(value="LOOSE")


def test_fill_is_undone(bpy, quad):
    select(bpy, quad, [1])
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.ssilk.fill_class(value="LOOSE")
    bpy.ops.ed.undo_push(message="after")
    bpy.ops.ed.undo()
    bpy.ops.object.mode_set(mode="OBJECT")
    assert palette.ATTRIBUTE not in bpy.data.objects["Quad"].data.attributes


def test_classes_survive_edits_of_the_mesh(bpy, quad):
    select(bpy, quad, [1, 2])
    bpy.ops.ssilk.fill_class(value="LOOSE")
    bpy.ops.mesh.select_all(action="SELECT")
    bpy.ops.mesh.subdivide(number_cuts=2)
    bpy.ops.object.mode_set(mode="OBJECT")
    x = np.array([vertex.co.x for vertex in quad.data.vertices])
    values = np.array(classes_of(quad))
    assert len(values) == 16
    assert set(values[x == 1]) == {2}
    assert set(values[x == -1]) == {1}
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.select_all(action="DESELECT")
    bpy.ops.object.mode_set(mode="OBJECT")
    quad.data.vertices.foreach_set("select", x == -1)
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.ops.mesh.delete(type="VERT")
    bpy.ops.object.mode_set(mode="OBJECT")
    assert classes_of(quad) == values[x != -1].tolist()


def test_classes_survive_saving(bpy, quad, tmp_path):
    bpy.ops.ssilk.paint_classes()
    paint(quad, [1], (0, 1, 0))
    bpy.ops.ssilk.take_up_painting()
    bpy.ops.object.mode_set(mode="OBJECT")
    path = str(tmp_path / "Blüten kleid.blend")
    bpy.ops.wm.save_as_mainfile(filepath=path)
    bpy.ops.wm.open_mainfile(filepath=path)
    assert classes_of(bpy.data.objects["Quad"]) == [1, 2, 1, 1]


def test_mirroring_takes_one_side_to_the_other(bpy, quad):
    bpy.ops.ssilk.paint_classes()
    paint(quad, [1], (0, 1, 0))
    paint(quad, [3], (0, 0, 0))
    assert bpy.ops.ssilk.mirror_classes(source="LEFT") == {"FINISHED"}
    assert classes_of(quad) == [2, 2, 1, 1]
    bpy.ops.ssilk.mirror_classes(source="RIGHT", distance=0.0)
    assert classes_of(quad) == [2, 2, 1, 1]


def test_mirroring_leaves_what_has_no_partner(bpy, quad):
    quad.data.vertices[1].co.y += 0.1
    bpy.ops.ssilk.paint_classes()
    paint(quad, [1, 2], (0, 1, 0))
    bpy.ops.ssilk.mirror_classes(source="LEFT", distance=0.05)
    assert classes_of(quad) == [1, 2, 2, 2]


def test_unusual_values_are_reported(bpy, quad):
    quad.data.attributes.new(palette.ATTRIBUTE, "INT", "POINT").data.foreach_set("value", [0, 1, 2, 7])
    with pytest.raises(RuntimeError, match="'Quad' holds values besides 0, 1 and 2") as raised:
        bpy.ops.ssilk.show_classes()
    assert "Traceback" not in str(raised.value)


@pytest.mark.parametrize(
    "mode, operator, reason",
    [
        ("EDIT", "paint_classes", "Go to Object Mode or Vertex Paint"),
        ("OBJECT", "fill_class", "Select vertices in Edit Mode"),
        ("OBJECT", "brush_class", "Choose Paint Classes first"),
    ],
)
def test_polls_say_why(bpy, quad, mode, operator, reason):
    bpy.ops.object.mode_set(mode=mode)
    with pytest.raises(RuntimeError, match=reason):
        getattr(bpy.ops.ssilk, operator)()


def test_no_mesh_is_no_garment(bpy, quad):
    activate(bpy, quad)
    bpy.data.objects.remove(quad)
    with pytest.raises(RuntimeError, match="Select the garment, a mesh, first"):
        bpy.ops.ssilk.paint_classes()


def half_loose(bpy, thing) -> None:
    thing.data.attributes.new(palette.ATTRIBUTE, "INT", "POINT").data.foreach_set("value", [0, 2, 2, 0])


def extrude(bpy, thing):
    select(bpy, thing, [1, 2])
    bpy.ops.mesh.extrude_region_move(TRANSFORM_OT_translate={"value": (1, 0, 0)})
    bpy.ops.object.mode_set(mode="OBJECT")


def bisect(bpy, thing):
    select(bpy, thing, [0, 1, 2, 3])
    bpy.ops.mesh.bisect(plane_co=(0.9, 0, 0), plane_no=(1, 0, 0))
    bpy.ops.object.mode_set(mode="OBJECT")


def mirror(bpy, thing):
    thing.modifiers.new("Mirror", "MIRROR").use_axis = (False, True, False)
    bpy.ops.object.modifier_apply(modifier="Mirror")


def join(bpy, thing):
    other = thing.copy()
    other.data = thing.data.copy()
    bpy.context.collection.objects.link(other)
    other.select_set(True)
    bpy.ops.object.join()


def duplicate(bpy, thing):
    bpy.ops.object.duplicate()


def triangulate(bpy, thing):
    select(bpy, thing, [0, 1, 2, 3])
    bpy.ops.mesh.quads_convert_to_tris()
    bpy.ops.object.mode_set(mode="OBJECT")


def edit_undone(bpy, thing):
    bpy.ops.ed.undo_push(message="before")
    extrude(bpy, thing)
    bpy.ops.ed.undo_push(message="after")
    bpy.ops.ed.undo()


@pytest.mark.parametrize("edit", [extrude, bisect, mirror, join, duplicate, triangulate, edit_undone])
def test_the_truth_survives(bpy, quad, edit):
    """Right of the middle stays loose and left of it pinned, whatever is done to the mesh."""
    half_loose(bpy, quad)
    edit(bpy, quad)
    thing = bpy.context.view_layer.objects.active
    x = np.array([vertex.co.x for vertex in thing.data.vertices])
    assert len(x) >= 4
    values = np.array(classes_of(thing))
    assert set(values[x > 0.95]) == {2}
    assert set(values[x < -0.95]) == {0}
    attribute = thing.data.attributes[palette.ATTRIBUTE]
    assert (attribute.data_type, attribute.domain) == ("INT", "POINT")


def test_shape_keys_do_not_matter_to_painting(bpy, quad):
    quad.shape_key_add(name="Basis")
    quad.shape_key_add(name="Wide").data[0].co.x -= 1
    bpy.ops.ssilk.paint_classes()
    paint(quad, [1], (0, 1, 0))
    bpy.ops.ssilk.take_up_painting()
    assert classes_of(quad) == [1, 2, 1, 1]
    assert quad.data.shape_keys.key_blocks["Wide"].data[0].co.x == -2


def test_operators_are_undone(bpy, quad):
    half_loose(bpy, quad)
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.ssilk.mirror_classes(source="LEFT")
    bpy.ops.ed.undo_push(message="after")
    assert classes_of(bpy.data.objects["Quad"]) == [2, 2, 2, 2]
    bpy.ops.ed.undo()
    assert classes_of(bpy.data.objects["Quad"]) == [0, 2, 2, 0]
