# SPDX-License-Identifier: Apache-2.0
"""Heat maps against closed forms, worst frames, and linear blend skinning beside the garment."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from mathutils import Matrix
from mathutils.bvhtree import BVHTree

from blender_addon.arrays import heat

from .conftest import activate, add_mesh, tube
from .scenes import ended, rig_and_animate
from .test_panels import drawn

RED, BLUE = heat.COLORS[-1], heat.COLORS[0]


def sheet(columns: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """A flat square sheet of triangles."""
    x, y = (part.reshape(-1) for part in np.mgrid[0:columns, 0:columns])
    a = np.arange(columns * columns).reshape(columns, columns)[:-1, :-1].reshape(-1)
    triangles = np.concatenate([np.c_[a, a + columns, a + 1], np.c_[a + 1, a + columns, a + columns + 1]])
    return np.stack([x, y, 0 * x], axis=1).astype(float), triangles


@pytest.mark.parametrize("seed", range(3))
def test_elongation_is_the_larger_principal_stretch_whatever_the_pose(seed):
    points, triangles = sheet()
    random = np.random.default_rng(seed)
    gradient = random.normal(size=(3, 2))
    moved = points[:, :2] @ gradient.T + random.normal(size=3)
    expected = np.linalg.svd(gradient, compute_uv=False)[0] - 1
    np.testing.assert_allclose(heat.elongations(points, moved, triangles), max(expected, 0), atol=1e-12)


def test_elongation_is_that_of_the_worst_triangle_at_each_vertex():
    points, triangles = sheet(3)
    moved = points.copy()
    moved[points[:, 0] == 2, 0] = 2.5  # the last column of triangles is half as long again
    np.testing.assert_allclose(
        heat.elongations(points, moved, triangles), np.where(points[:, 0] >= 1, 0.5, 0), atol=1e-12
    )


def test_triangles_without_a_plane_are_left_out():
    points = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    assert heat.elongations(points, 5 * points, np.array([[0, 1, 2], [1, 1, 2]])).tolist() == [0, 0, 0]


def test_colours_run_from_grey_over_blue_to_red():
    found = heat.colors_of(np.array([-1.0, 0.0, 1e-9, 0.5, 1.0, 7.0]), 1.0)
    np.testing.assert_allclose(found[:, :3], [heat.GREY, heat.GREY, BLUE, heat.COLORS[2], RED, RED], atol=1e-6)
    assert (found[:, 3] == 1).all()


def test_the_side_is_right_beyond_sharp_corners_too():
    """A flat spike: the face whose plane a point lies behind is often as near as any other."""
    body = np.array([[0, 0, 0], [0.1, 0, 0], [0.03, 0.1, 0], [0.03, 0.03, 2]])
    triangles = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    tree = BVHTree.FromPolygons(body.tolist(), triangles.tolist())
    random = np.random.default_rng(0)
    points = np.concatenate(
        [random.uniform(-0.5, 2.5, (2000, 3)) * [0.3, 0.3, 1], random.dirichlet([1] * 4, 500) @ body]
    )
    found = [tree.find_nearest(point) for point in points.tolist()]
    places, nearest = (np.array([each[part] for each in found]) for part in (0, 2))
    normals = np.cross(*(body[triangles[:, corner]] - body[triangles[:, 0]] for corner in (1, 2)))
    inside = (((points[:, None] - body[triangles[:, 0]]) * normals).sum(-1) < 0).all(axis=1)
    depths = heat.depths(points, places, nearest, body, triangles)
    np.testing.assert_array_equal(depths > 0, inside)
    np.testing.assert_allclose(np.abs(depths), np.linalg.norm(points - places, axis=1))
    assert 500 <= inside.sum() < 600


def test_the_worst_frames_lie_apart_and_above_zero():
    values = np.array([0.0, 3, 9, 8, 1, 0, 0, 5, 0, -2])
    assert heat.worst_frames(values, 5, 3) == [2, 7]
    assert heat.worst_frames(values, 3, 1) == [2, 3, 7]
    assert heat.worst_frames(-values.clip(0), 3, 1) == []


@pytest.fixture
def dressed(bpy, skirt):
    """The skirt and its pillar; the garment becomes a tube that is 20 mm inside the pillar over its upper half."""
    pillar = bpy.data.objects["Pillar"]
    inside = add_mesh(bpy, "Sleeve", *tube(24, 9, (0.6, 1.0, 1.3), (0.2, 0.13, 0.13)))
    inside.ssilk.armature = bpy.data.objects["Rig"]
    bpy.data.objects.remove(skirt)
    activate(bpy, inside)
    assert len(pillar.data.vertices) == 288
    return inside


def depths(bpy, garment) -> np.ndarray:
    from blender_addon.quality.heat import PENETRATION, measuring

    steps = measuring(garment, PENETRATION, bpy.context.evaluated_depsgraph_get())
    while True:
        try:
            assert 0 <= next(steps) <= 1
        except StopIteration as end:
            return end.value.values


def expected_depths(garment) -> np.ndarray:
    """Of points about a pillar of 16 sides, to the nearest one of these."""
    points = np.array([vertex.co for vertex in garment.data.vertices])[:, None, :2]
    corners = 0.15 * np.stack([np.cos(np.arange(17) * np.pi / 8), np.sin(np.arange(17) * np.pi / 8)], axis=1)
    begin, side = corners[:-1], np.diff(corners, axis=0)
    along = (((points - begin) * side).sum(-1) / (side**2).sum(-1)).clip(0, 1)
    away = np.linalg.norm(points - begin - along[..., None] * side, axis=-1).min(axis=1)
    outward = np.stack([side[:, 1], -side[:, 0]], axis=1)
    inside = (((points - begin) * outward).sum(-1) < 0).all(axis=1)
    return np.where(inside, away, -away)


@pytest.mark.parametrize("scale", [1.0, 0.01])
def test_penetration_is_the_depth_behind_the_nearest_triangle_in_metres(bpy, dressed, scale):
    bpy.context.scene.unit_settings.scale_length = scale
    np.testing.assert_allclose(depths(bpy, dressed), scale * expected_depths(dressed), atol=1e-5 * scale)


def test_moved_turned_and_scaled_objects_make_no_difference(bpy, dressed):
    before = depths(bpy, dressed)
    pillar = bpy.data.objects["Pillar"]
    for thing, scale in ((pillar, (2, 0.5, 1)), (dressed, (-1.5, 1, 3))):
        points = np.array([vertex.co for vertex in thing.data.vertices])
        thing.data.vertices.foreach_set("co", (points / scale).astype(np.float32).reshape(-1))
        thing.data.update()
        thing.scale = scale
    bpy.context.view_layer.update()
    np.testing.assert_allclose(depths(bpy, dressed), before, atol=2e-5)
    pillar.data.transform(Matrix.Scale(-1, 4, (1, 0, 0)))  # the same pillar, mirrored in its mesh and as an object
    pillar.data.flip_normals()
    pillar.scale.x = -2
    bpy.context.view_layer.update()
    np.testing.assert_allclose(depths(bpy, dressed), before, atol=2e-5)


def colors(garment) -> np.ndarray:
    layer = garment.data.color_attributes["SSILK Heat"]
    assert (layer.data_type, layer.domain) == ("FLOAT_COLOR", "POINT")
    assert garment.data.color_attributes.active_color == layer
    found = np.empty(len(layer.data) * 4, dtype=np.float32)
    layer.data.foreach_get("color_srgb", found)
    return found.reshape(-1, 4)


def test_heat_is_shown_follows_frames_and_goes(bpy, dressed):
    from blender_addon.quality import heat_updates

    assert bpy.ops.ssilk.show_heat(kind="PENETRATION", deepest=0.02) == {"FINISHED"}
    expected = heat.colors_of(expected_depths(dressed), 0.02)
    np.testing.assert_allclose(colors(dressed), expected, atol=2e-3)
    assert np.ptp(colors(dressed), axis=0)[:3].min() > 0.2
    assert dressed.show_in_front  # else the skin that it lies in would hide it
    inside, deepest = np.sum(expected_depths(dressed) > 0), 1000 * expected_depths(dressed).max()
    from blender_addon.panels import QualityPanel

    said = f"{inside} vertices inside, {deepest:.1f} mm at most"
    assert said in " ".join(drawn(QualityPanel, bpy.context))
    dressed.scale = (3, 3, 1)
    bpy.context.scene.frame_set(5)
    while heat_updates.go_on() is not None:  # what a timer does as soon as the frame stands
        pass
    np.testing.assert_allclose(colors(dressed)[:, :3], np.tile(heat.GREY, (len(expected), 1)), atol=2e-3)
    assert "Nothing is inside" in drawn(QualityPanel, bpy.context)
    assert bpy.ops.ssilk.hide_heat() == {"FINISHED"}
    assert not dressed.show_in_front and "ssilk_in_front" not in dressed
    assert "Nothing is inside" not in drawn(QualityPanel, bpy.context)
    assert "SSILK Heat" not in dressed.data.color_attributes and not dressed.ssilk.heat


@pytest.mark.parametrize("kind", ["SKIN", "PENETRATION"])
def test_the_active_colour_attribute_is_what_it_was_when_heat_goes(bpy, dressed, kind):
    mesh = (bpy.data.objects["Pillar"] if kind == "SKIN" else dressed).data
    for name in ("Freckles", "Paint", "Rouge"):
        mesh.color_attributes.new(name, "FLOAT_COLOR", "POINT")
    mesh.color_attributes.active_color = mesh.color_attributes["Paint"]
    for _ in range(2):  # the second time over the first
        assert bpy.ops.ssilk.show_heat(kind=kind) == {"FINISHED"}
    assert mesh.color_attributes.active_color_name == "SSILK Heat"
    assert bpy.ops.ssilk.hide_heat() == {"FINISHED"}
    assert mesh.color_attributes.active_color_name == "Paint" and "ssilk_active_color" not in mesh


def test_skin_that_shows_is_coloured_on_the_body(bpy, dressed):
    """A sleeve 20 mm off the pillar covers it over its length; a shape key takes its upper half 20 mm inside."""
    pillar = bpy.data.objects["Pillar"]
    points = np.array([vertex.co for vertex in dressed.data.vertices])
    points[:, 2] = 0.65 + (points[:, 2] - 0.6) * 0.6 / 0.7  # no vertex of the pillar is at its ends
    points[:, :2] *= 0.17 / np.linalg.norm(points[:, :2], axis=1, keepdims=True)
    dressed.data.vertices.foreach_set("co", points.astype(np.float32).reshape(-1))
    dressed.shape_key_add(name="Basis")
    key = dressed.shape_key_add(name="Tight")
    for point in key.data:
        if point.co.z > 0.99:
            point.co.x, point.co.y = 0.13 / 0.17 * point.co.x, 0.13 / 0.17 * point.co.y
    for frame, value in ((1, 0.0), (2, 1.0)):
        key.value = value
        key.keyframe_insert("value", frame=frame)
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = 1, 2
    bpy.context.scene.frame_set(1)
    assert bpy.ops.ssilk.show_heat(kind="SKIN", deepest=0.02) == {"FINISHED"}
    np.testing.assert_allclose(colors(pillar)[:, :3], np.tile(heat.GREY, (288, 1)), atol=2e-3)
    assert bpy.ops.ssilk.find_worst(kind="SKIN") == {"FINISHED"}
    (mark,) = bpy.context.scene.timeline_markers
    z = np.array([vertex.co.z for vertex in pillar.data.vertices])
    covered, high = (z > 0.65) & (z < 1.25), (z > 0.95) & (z < 1.25)
    assert mark.frame == 2 and mark.name == f"SSILK {high.sum() / covered.sum():.2%} of the covered skin shows"
    bpy.context.scene.frame_set(2)
    assert bpy.ops.ssilk.show_heat(kind="SKIN", deepest=0.02) == {"FINISHED"}
    found = colors(pillar)[:, :3]
    deep = high & (z > 1.05)
    np.testing.assert_allclose(found[deep], np.tile(RED, (deep.sum(), 1)), atol=0.15)
    assert (np.abs(found[high] - heat.GREY).max(axis=1) > 0.1).all()
    np.testing.assert_allclose(found[~high], np.tile(heat.GREY, ((~high).sum(), 1)), atol=2e-3)
    for point in key.data:  # the upper half is out of reach
        if point.co.z > 0.99:
            point.co.x, point.co.y = 9 * point.co.x, 9 * point.co.y
    assert bpy.ops.ssilk.show_heat(kind="SKIN", deepest=0.02) == {"FINISHED"}
    assert dressed.ssilk.heat_told == f"No skin shows, {high.sum() / covered.sum():.2%} is bare"
    assert "SSILK Heat" not in dressed.data.color_attributes
    assert bpy.ops.ssilk.show_heat(kind="STRETCH") == {"FINISHED"}
    assert "SSILK Heat" not in pillar.data.color_attributes and "SSILK Heat" in dressed.data.color_attributes
    bpy.ops.ssilk.show_heat(kind="SKIN")
    assert bpy.ops.ssilk.hide_heat() == {"FINISHED"}
    assert "SSILK Heat" not in pillar.data.color_attributes and not dressed.ssilk.heat


def test_what_intersects_is_coloured(bpy, dressed):
    """Tubes that stand in one another; the inner one is bent through the outer one, and then through itself."""
    outer = add_mesh(bpy, "Coat", *tube(24, 9, (0.6, 1.0, 1.3), (0.3, 0.3, 0.3)))
    outer.ssilk.armature = dressed.ssilk.armature
    activate(bpy, dressed)
    assert bpy.ops.ssilk.show_heat(kind="INTERSECTIONS") == {"FINISHED"}
    assert dressed.ssilk.heat_told == "Nothing intersects"
    dressed.shape_key_add(name="Basis")
    key = dressed.shape_key_add(name="Wrong")
    moved = [point.co.z > 1.2 for point in key.data]
    for point, high in zip(key.data, moved):
        point.co.x += 0.25 * high  # the top goes through the coat
    key.value = 1.0
    assert bpy.ops.ssilk.show_heat(kind="INTERSECTIONS") == {"FINISHED"}
    assert dressed.ssilk.heat_told.endswith("% intersect other garments") and "others" not in dressed.ssilk.heat_told
    coloured = np.abs(colors(dressed)[:, :3] - heat.GREY).max(axis=1) > 0.1
    np.testing.assert_allclose(colors(dressed)[coloured, :3], np.tile(RED, (coloured.sum(), 1)), atol=2e-3)
    z = np.array([vertex.co.z for vertex in dressed.data.vertices])
    assert coloured.any() and z[coloured].min() > 1.0
    bpy.data.objects.remove(outer)
    for point, high in zip(key.data, moved):
        point.co.x, point.co.z = point.co.x - 0.25 * high + 0.05 * high, point.co.z - 0.4 * high  # into the skirt
    assert bpy.ops.ssilk.show_heat(kind="INTERSECTIONS") == {"FINISHED"}
    assert dressed.ssilk.heat_told.endswith("% intersect others")


def test_heat_is_not_tinted_by_the_overlay_of_classes(bpy, dressed, monkeypatch):
    from blender_addon.scene import overlay

    hidden = []
    monkeypatch.setattr(overlay, "hide", lambda: hidden.append(True))
    assert bpy.ops.ssilk.show_heat(kind="STRETCH") == {"FINISHED"}
    assert hidden


def test_the_panel_offers_to_hide_what_is_shown(bpy, dressed):
    from blender_addon.panels.quality import QualityPanel

    shown = ["ssilk.show_heat", "ssilk.find_worst"] * 4
    assert drawn(QualityPanel, bpy.context) == [*shown, "ssilk.clear_worst", "ssilk.toggle_lbs"]
    bpy.ops.ssilk.show_heat()
    told = dressed.ssilk.heat_told
    assert drawn(QualityPanel, bpy.context) == [
        *shown, told, "ssilk.hide_heat", "ssilk.clear_worst", "ssilk.toggle_lbs"
    ]  # fmt: skip


def test_stretch_is_that_of_what_blender_shows(bpy, dressed):
    """Keys of a bake stretch cloth; the artist's own give it the shape that it has at rest."""
    dressed.shape_key_add(name="Basis")
    for name in ("Longer", "SSILK Longer"):
        longer = dressed.shape_key_add(name=name, from_mix=name != "Longer")
        for point in longer.data:
            point.co.z *= 1.25
        longer.value = 1.0
        if name != "Longer":
            longer.relative_key = dressed.data.shape_keys.key_blocks["Longer"]
    assert bpy.ops.ssilk.show_heat(kind="STRETCH", longest=0.25) == {"FINISHED"}
    found = colors(dressed)
    upright = np.array([vertex.co.z > 1.05 for vertex in dressed.data.vertices])  # where the tube is upright
    np.testing.assert_allclose(found[upright, :3], np.tile(RED, (upright.sum(), 1)), atol=5e-3)


def test_worst_frames_are_marked_and_the_timeline_stays(bpy, dressed):
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end, scene.render.fps = 1, 60, 30
    for frame, width in ((1, 2.0), (18, 2.0), (20, 1.0), (22, 2.0), (48, 2.0), (50, 1.06), (52, 2.0)):
        dressed.scale = (width, width, 1)
        dressed.keyframe_insert("scale", frame=frame)
    scene.frame_set(7)
    scene.timeline_markers.new("Mine", frame=3)
    for _ in range(2):  # the second time replaces what the first one marked
        assert bpy.ops.ssilk.find_worst(kind="PENETRATION") == {"FINISHED"}
    marks = sorted((marker.frame, marker.name) for marker in scene.timeline_markers)
    assert [frame for frame, _ in marks] == [3, 20, 50] and scene.frame_current == 7
    assert marks[1][1].startswith("SSILK ") and "mm at most" in marks[1][1]
    assert bpy.ops.ssilk.clear_worst() == {"FINISHED"}
    assert [marker.name for marker in scene.timeline_markers] == ["Mine"]


def test_what_cannot_be_measured_is_said(bpy, dressed):
    dressed.modifiers.new("Other side", "MIRROR")
    with pytest.raises(RuntimeError, match="A modifier gives 'Sleeve'"):
        bpy.ops.ssilk.show_heat()
    dressed.modifiers.clear()
    bpy.data.objects.remove(bpy.data.objects["Pillar"])
    with pytest.raises(RuntimeError, match="No body is bound"):
        bpy.ops.ssilk.find_worst()
    assert not dressed.ssilk.heat and "SSILK Heat" not in dressed.data.color_attributes


def test_linear_blend_skinning_stands_beside_and_goes(ready, skirt, ssilk_python, tmp_path):
    """The copy is what the model's LBS weights give; nothing of it is left afterwards."""
    bpy = ready
    rig_and_animate(bpy, skirt)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "beside.blend"))
    assert bpy.ops.ssilk.find_motions() == {"FINISHED"}
    bpy.ops.ssilk.show_classes()
    skirt.ssilk.training.preset, skirt.ssilk.training.iterations = "draft", 2
    assert bpy.ops.ssilk.train() == {"FINISHED"}
    assert ended(skirt).state == "done"
    bpy.ops.ssilk.play_live()
    bpy.context.scene.frame_set(21)
    bpy.ops.ssilk.show_heat(kind="STRETCH")
    before = {kind: len(getattr(bpy.data, kind)) for kind in ("objects", "meshes", "collections", "shape_keys")}
    assert bpy.ops.ssilk.toggle_lbs() == {"FINISHED"}
    copy = bpy.data.objects["Skirt LBS"]
    assert not copy.ssilk.live and not copy.ssilk.heat and "SSILK Heat" not in copy.data.attributes
    assert not copy.data.color_attributes and "SSILK Classes" in skirt.data.color_attributes
    assert skirt.ssilk.live and skirt.ssilk.heat and "SSILK Heat" in skirt.data.attributes
    depsgraph = bpy.context.evaluated_depsgraph_get()
    (found,) = [
        world_points(each.object, each.matrix_world)
        for each in depsgraph.object_instances
        if each.is_instance and each.object.type == "MESH"
    ]
    found -= [1.3 * max(skirt.dimensions[:2]), 0, 0]
    lbs = linearly_skinned(bpy, skirt)
    assert np.abs(found - lbs).max() < 1e-4
    assert bpy.ops.ssilk.toggle_lbs() == {"FINISHED"}
    assert {kind: len(getattr(bpy.data, kind)) for kind in before} == before


def world_points(evaluated, world) -> np.ndarray:
    points = np.array([vertex.co for vertex in evaluated.data.vertices])
    return points @ np.array(world)[:3, :3].T + np.array(world)[:3, 3]


def linearly_skinned(bpy, skirt) -> np.ndarray:
    """Skin by the model's LBS weights and Blender's own pose matrices."""
    from blender_addon.playback.models import model_of
    from ssilk_core.network.checkpoint import load_model

    scene, armature = load_model(model_of(skirt)).scene, bpy.data.objects["Rig"]
    names = [path.rpartition("/")[2] for path in scene.joint_names]
    points = np.array([(*vertex.co, 1) for vertex in skirt.data.shape_keys.reference_key.data])
    weights = scene.lbs_skin.dense(len(names))
    moved = np.zeros((len(points), 3))
    for name, share in zip(names, weights.T):
        bone = armature.pose.bones[name]
        moved += share[:, None] * (points @ np.array(bone.matrix @ bone.bone.matrix_local.inverted()).T)[:, :3]
    return moved
