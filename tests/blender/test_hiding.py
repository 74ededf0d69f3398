# SPDX-License-Identifier: Apache-2.0
"""Covered skin is hidden by a mask, and shown again; the body's own mesh stays as it is."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from .conftest import BONES, HEIGHTS, activate, add_mesh, tube
from .test_panels import drawn

NAME = "SSILK Under Skirt"


@pytest.fixture
def pillar(bpy, skirt):
    """A pillar of smaller faces in the place of the first; three frames."""
    bpy.data.objects.remove(bpy.data.objects["Pillar"])
    pillar = add_mesh(bpy, "Pillar", *tube(24, 69, (0.0, 1.7), (0.15, 0.15)))
    for name, low, high in zip(BONES, (0.0, *HEIGHTS[1:]), (*HEIGHTS[1:], 9.0)):
        inside = [vertex.index for vertex in pillar.data.vertices if low <= vertex.co.z < high]
        pillar.vertex_groups.new(name=name).add(inside, 1.0, "REPLACE")
    pillar.modifiers.new("Armature", "ARMATURE").object = bpy.data.objects["Rig"]
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = 1, 3
    activate(bpy, skirt)
    return pillar


def shown_faces(bpy, pillar) -> set[tuple[int, ...]]:
    """Return the faces that are shown, by the rounded heights and angles of their middles."""
    mesh = pillar.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    return {tuple(np.round(polygon.center, 3)) for polygon in mesh.polygons}


def test_covered_skin_is_hidden_shown_and_hidden_anew(bpy, skirt, pillar):
    whole, groups = shown_faces(bpy, pillar), len(pillar.vertex_groups)
    assert bpy.ops.ssilk.hide_covered() == {"FINISHED"}
    hidden = whole - shown_faces(bpy, pillar)
    heights = np.array(sorted(hidden))[:, 2]
    assert len(hidden) > 50 and heights.min() > 0.92 and heights.max() < 1.27
    assert len(pillar.data.polygons) == len(whole) and NAME in pillar.vertex_groups
    skirt.location.z = -0.05
    skirt.keyframe_insert("location", frame=3)
    skirt.location.z = 0
    skirt.keyframe_insert("location", frame=1)
    assert bpy.ops.ssilk.hide_covered() == {"FINISHED"}
    assert whole - shown_faces(bpy, pillar) < hidden and bpy.context.scene.frame_current == 1
    assert [modifier.type for modifier in pillar.modifiers] == ["ARMATURE", "MASK"]
    assert bpy.ops.ssilk.show_covered() == {"FINISHED"}
    assert shown_faces(bpy, pillar) == whole
    assert len(pillar.vertex_groups) == groups and len(pillar.modifiers) == 1
    assert not bpy.ops.ssilk.show_covered.poll()


def test_skin_under_a_renamed_garment_is_found_again(bpy, skirt, pillar):
    whole = shown_faces(bpy, pillar)
    assert bpy.ops.ssilk.hide_covered() == {"FINISHED"}
    hidden = whole - shown_faces(bpy, pillar)
    skirt.name = "Kilt"
    assert bpy.ops.ssilk.hide_covered() == {"FINISHED"}  # in place of what was hidden under the old name
    assert [modifier.name for modifier in pillar.modifiers] == ["Armature", "SSILK Under Kilt"]
    assert whole - shown_faces(bpy, pillar) == hidden
    skirt.name = "Skirt"
    other = skirt.copy()
    bpy.context.scene.collection.objects.link(other)
    other.name = "Kilt"
    activate(bpy, other)
    assert not bpy.ops.ssilk.show_covered.poll()  # a namesake hides nothing
    activate(bpy, skirt)
    assert bpy.ops.ssilk.show_covered() == {"FINISHED"}
    assert shown_faces(bpy, pillar) == whole and not [key for key in pillar.keys() if "Under" in key]  # noqa: SIM118


def test_inner_cloth_is_hidden_under_an_outer_garment_and_shown_again(bpy, skirt, pillar):
    """Where the outer garment covers its outside, and the body its inside; training and baking read all of it."""
    from blender_addon.scene.garment import put_in_order
    from blender_addon.scene.gather import gather

    tight = add_mesh(bpy, "Tights", *tube(24, 41, (0.5, 1.5), (0.16, 0.16)))
    for name, low, high in zip(BONES, (0.0, *HEIGHTS[1:]), (*HEIGHTS[1:], 9.0)):
        inside = [vertex.index for vertex in tight.data.vertices if low <= vertex.co.z < high]
        tight.vertex_groups.new(name=name).add(inside, 1.0, "REPLACE")
    tight.modifiers.new("Armature", "ARMATURE").object = bpy.data.objects["Rig"]
    tight.ssilk.armature = skirt.ssilk.armature = bpy.data.objects["Rig"]
    put_in_order([tight, skirt])
    whole, faces = shown_faces(bpy, tight), len(tight.data.polygons)
    activate(bpy, skirt)
    assert bpy.ops.ssilk.hide_covered() == {"FINISHED"}
    hidden = whole - shown_faces(bpy, tight)
    heights = np.array(sorted(hidden))[:, 2]
    assert len(hidden) > 20 and heights.min() > 0.92 and heights.max() < 1.27
    assert len(tight.data.polygons) == faces and tight.modifiers[-1].name == NAME
    assert len(gather(tight, classes=False, proxies=False).garment.mesh.polygon_counts) == faces
    assert bpy.ops.ssilk.hide_covered() == {"FINISHED"}  # in place of what was hidden
    assert whole - shown_faces(bpy, tight) == hidden and len(tight.modifiers) == 2
    assert bpy.ops.ssilk.show_covered() == {"FINISHED"}
    assert shown_faces(bpy, tight) == whole and len(tight.modifiers) == 1
    tight.hide_set(True)
    assert bpy.ops.ssilk.hide_covered() == {"FINISHED"}  # a hidden garment needs none
    assert len(tight.modifiers) == 1
    put_in_order([skirt, tight])
    tight.hide_set(False)
    assert bpy.ops.ssilk.hide_covered() == {"FINISHED"}  # nothing beneath
    assert len(tight.modifiers) == 1


def test_hiding_is_one_step_to_undo(bpy, skirt, pillar):
    bpy.ops.ed.undo_push(message="before")
    assert bpy.ops.ssilk.hide_covered() == {"FINISHED"}
    bpy.ops.ed.undo()
    pillar = bpy.data.objects["Pillar"]
    assert NAME not in pillar.modifiers and NAME not in pillar.vertex_groups


def test_what_is_measured_is_the_whole_body(bpy, skirt, pillar):
    assert bpy.ops.ssilk.hide_covered() == {"FINISHED"}
    with pytest.raises(RuntimeError, match=r"Skin of .Pillar. is hidden.*choose Show Covered Skin first"):
        bpy.ops.ssilk.show_heat()
    assert bpy.ops.ssilk.show_heat(kind="STRETCH") == {"FINISHED"}


def test_a_skirt_that_flies_hides_nothing(bpy, skirt, pillar):
    whole = shown_faces(bpy, pillar)
    for frame, height in ((1, 0.0), (2, 0.9)):
        skirt.location.z = height
        skirt.keyframe_insert("location", frame=frame)
    assert bpy.ops.ssilk.hide_covered() == {"FINISHED"}
    assert shown_faces(bpy, pillar) == whole and len(pillar.modifiers) == 1


def finer_before_bones(pillar) -> None:
    pillar.modifiers.new("Finer", "SUBSURF")
    pillar.modifiers.move(1, 0)


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (lambda skirt, pillar: pillar.hide_set(True), "'Pillar' is not visible"),
        (lambda skirt, pillar: finer_before_bones(pillar), "A modifier gives 'Pillar'"),
    ],
)
def test_what_cannot_be_compared_is_refused_and_nothing_changes(bpy, skirt, pillar, spoil, sentence):
    spoil(skirt, pillar)
    with pytest.raises(RuntimeError, match=sentence):
        bpy.ops.ssilk.hide_covered()
    assert NAME not in pillar.modifiers and bpy.context.scene.frame_current == 1


def test_the_panel_offers_both(bpy, skirt, pillar):
    from blender_addon.panels.playback import BakingPanel

    assert {"ssilk.hide_covered", "ssilk.show_covered"} <= set(drawn(BakingPanel, bpy.context))


@pytest.mark.parametrize("variants", [False, True])
def test_blender_imports_a_body_without_its_hidden_faces(bpy, tmp_path, variants):
    from blender_addon.scene.handover import expose_usd

    expose_usd()
    from pxr import Usd, UsdGeom
    from ssilk_usd.units import StageUnits
    from ssilk_usd.writing.author import define_mesh
    from ssilk_usd.writing.body_faces import BODY, FULL, HiddenPolygons, hide_polygons

    from ssilk_core.scene.assets import Mesh

    points, quads = tube(8, 4, (0.0, 1.0), (0.2, 0.2))
    triangles = np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])
    corners = quads.reshape(-1)
    uvs = np.stack([corners, -corners], axis=1)
    mesh = Mesh("/Root/Body", points, triangles, np.full(len(quads), 4), corners, uvs)
    stage = Usd.Stage.CreateNew(str(tmp_path / "body.usdc"))
    root = UsdGeom.Xform.Define(stage, "/Root")
    path = define_mesh(stage, root.GetPath().AppendChild("Body"), mesh, StageUnits(1.0, "Z")).GetPath()
    hidden = np.arange(len(quads)) % 3 == 0
    hide_polygons(stage, root.GetPath(), [path], [mesh], HiddenPolygons((hidden,), variants))
    stage.Save()
    np.testing.assert_array_equal(imported(bpy, tmp_path), quads[~hidden])
    if variants:
        root.GetPrim().GetVariantSet(BODY).SetVariantSelection(FULL)
        stage.Save()
        np.testing.assert_array_equal(imported(bpy, tmp_path), quads)


def imported(bpy, folder) -> np.ndarray:
    """Return the faces of the body as Blender imports it, whose texture coordinates name their corners."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.wm.usd_import(filepath=str(folder / "body.usdc"))
    mesh = bpy.data.objects["Body"].data
    faces = np.array([polygon.vertices[:] for polygon in mesh.polygons])
    coordinates = np.array([loop.uv[:] for loop in mesh.uv_layers.active.data])
    np.testing.assert_array_equal(coordinates, np.stack([faces.reshape(-1), -faces.reshape(-1)], axis=1))
    return faces
