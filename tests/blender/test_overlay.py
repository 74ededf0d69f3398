# SPDX-License-Identifier: Apache-2.0
"""What the overlay of classes draws, in any mode, and that it leaves nothing behind."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from blender_addon.arrays.classes import COLORS


@pytest.fixture
def painted(bpy, skirt):
    """The skirt, loose below 0.9 m, moved and turned, with a bone that moves it."""
    values = [2 if vertex.co.z < 0.9 else 1 for vertex in skirt.data.vertices]
    skirt.data.attributes.new("ssilk:class", "INT", "POINT").data.foreach_set("value", values)
    skirt.location = (0.5, 0, 0)
    skirt.rotation_euler = (0, 0, 1)
    bpy.context.view_layer.update()
    return skirt


def surface(bpy, thing):
    from blender_addon.scene.overlay import class_surface

    bpy.context.view_layer.update()
    return class_surface(thing, bpy.context.evaluated_depsgraph_get())


@pytest.mark.parametrize("mode", ["OBJECT", "EDIT", "SCULPT", "VERTEX_PAINT", "WEIGHT_PAINT"])
def test_every_mode_shows_the_classes_where_the_cloth_is(bpy, painted, mode):
    bpy.ops.object.mode_set(mode=mode)
    points, colors, triangles = surface(bpy, painted)
    expected = np.array([painted.matrix_world @ vertex.co for vertex in painted.data.vertices])
    np.testing.assert_allclose(points, expected, atol=1e-6)
    loose = expected[:, 2] < 0.9
    np.testing.assert_array_equal(colors[:, :3], np.where(loose[:, None], COLORS[2], COLORS[1]))
    assert triangles.shape == (2 * len(painted.data.polygons), 3)
    assert np.array_equal(np.unique(triangles), np.arange(len(points)))


def test_it_follows_the_bones_and_the_modifiers(bpy, painted):
    armature = bpy.data.objects["Rig"]
    painted.vertex_groups.new(name="Hips").add(list(range(312)), 1.0, "REPLACE")
    painted.modifiers.new("Armature", "ARMATURE").object = armature
    before = surface(bpy, painted)[0]
    armature.pose.bones["Hips"].location = (0, 0.3, 0)
    after, colors, _ = surface(bpy, painted)
    np.testing.assert_allclose(after - before, np.tile([0, 0, 0.3], (312, 1)), atol=1e-5)
    painted.modifiers.new("Subdivision", "SUBSURF")
    points, colors, _ = surface(bpy, painted)
    assert len(points) > 1000
    assert {tuple(color) for color in colors[:, :3]} == {tuple(COLORS[1]), tuple(COLORS[2])}


def test_what_is_being_painted_is_shown_before_it_is_taken_up(bpy, painted):
    bpy.ops.ssilk.paint_classes()
    painted.data.color_attributes.active_color.data[7].color_srgb = (0.1, 0.0, 0.0, 1.0)
    np.testing.assert_array_equal(surface(bpy, painted)[1][7], [0, 0, 0, 1])


@pytest.mark.parametrize("mode", ["OBJECT", "EDIT"])
def test_nothing_is_drawn_without_classes_or_with_broken_ones(bpy, skirt, mode):
    bpy.ops.object.mode_set(mode=mode)
    assert surface(bpy, skirt) is None
    bpy.ops.object.mode_set(mode="OBJECT")
    skirt.data.attributes.new("ssilk:class", "INT", "POINT").data.foreach_set("value", [9] * 312)
    bpy.ops.object.mode_set(mode=mode)
    assert surface(bpy, skirt) is None


def test_there_is_none_in_background(bpy, skirt):
    from blender_addon.scene import overlay

    with pytest.raises(RuntimeError, match="no window to draw in"):
        bpy.ops.ssilk.toggle_overlay()
    overlay.show()
    assert not overlay.shown()


def test_disabling_takes_it_away(bpy, skirt, monkeypatch):
    import addon_utils

    from blender_addon.scene import overlay

    handlers: list[object] = []
    views = SimpleNamespace(
        draw_handler_add=lambda *given: handlers.append(given[0]) or given[0],
        draw_handler_remove=lambda handle, _: handlers.remove(handle),
    )
    fake = SimpleNamespace(app=SimpleNamespace(background=False), types=SimpleNamespace(SpaceView3D=views))
    monkeypatch.setattr(overlay, "bpy", fake)
    overlay.show()
    overlay.show()
    assert (len(handlers), overlay.shown()) == (1, True)
    addon_utils.disable("blender_addon")
    assert (handlers, overlay.shown()) == ([], False)


def test_the_projection_comes_nearer_by_the_same_depth_everywhere(bpy):
    from mathutils import Matrix, Vector

    from blender_addon.scene.overlay import NEARER, _nearer

    lens = Matrix(((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, -1.02, -0.2), (0, 0, -1, 0)))
    for point in (Vector((0, 0, -1, 1)), Vector((2, 1, -9, 1))):
        before, after = lens @ point, _nearer(lens) @ point
        assert before.z / before.w - after.z / after.w == pytest.approx(NEARER, rel=1e-2)
        assert before.xy == after.xy
