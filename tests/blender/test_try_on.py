# SPDX-License-Identifier: Apache-2.0
"""Garments tried on other bodies in Blender: as `ssilk rig --onto` carries them, and without a trace."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from blender_addon.arrays.heat import told_inside
from blender_addon.arrays.try_on import KNOTS, knot_values, member_points
from blender_addon.errors import SetupError
from ssilk_core.scene.assets import Body, Character, Mesh, Skeleton, SkinWeights

from .conftest import activate, opened
from .test_panels import drawn
from .test_shapes import fuller

EXACT = 2e-6  # [m] of single precision
CUBE = np.array([[x, y, z] for x in (0, 0.3) for y in (0, 1.7) for z in (0, 0.2)], dtype=float)
SIDES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])


def character(
    points: np.ndarray = CUBE, sides: np.ndarray = SIDES, name: str = "Body", joints: tuple[str, ...] = ("a", "a/b")
) -> Character:
    faces = np.concatenate([sides[:, [0, 1, 2]], sides[:, [0, 2, 3]]])
    mesh = Mesh(f"/Character/{name}", points, faces, np.full(len(sides), 4), sides.reshape(-1))
    count = len(joints)
    binds = np.tile(np.eye(4), (count, 1, 1))
    skeleton = Skeleton("/S", joints, np.arange(count) - 1, binds, binds)
    weights = np.zeros((len(points), count), dtype=np.float32)
    weights[:, 0] = 1
    return Character("tall.usd", skeleton, (Body(mesh, SkinWeights.from_dense(mesh.path, weights)),))


def test_a_share_is_between_the_two_knots_beside_it():
    for number, knot in enumerate(KNOTS):
        assert knot_values(knot) == tuple(float(each == number) for each in range(len(KNOTS)))
    assert knot_values(0.0) == (0, 0, 0, 0)
    assert knot_values(0.125) == (0, 0.25, 0, 0)
    assert knot_values(-0.125) == (0.5, 0, 0, 0)
    assert knot_values(0.75) == (0, 0.5, 0.5, 0)


TALL = CUBE * (1, 1.1, 1)
QUARTER = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # about the vertical


@pytest.mark.parametrize(
    "other",
    [
        character(TALL),
        character(TALL, np.roll(SIDES[::-1], 1, axis=1), "Mesh", ("a", "a/b", "a/b/helper")),
        character(TALL @ QUARTER.T + (3, 0, -2)),
        character(TALL + (0, 0.4, 1)),
    ],
    ids=["as it is", "otherwise named, with faces that begin elsewhere", "turned", "elsewhere"],
)
def test_a_member_of_the_family_is_brought_to_where_the_character_stands(other):
    (points,) = member_points(character(), other)
    # Its feet stay on the ground, and what was moved stands over the same place.
    np.testing.assert_allclose(points, TALL, atol=1e-9)


@pytest.mark.parametrize(
    ("other", "told"),
    [
        (character(joints=("a", "a/c")), r"1 joints? missing \(b\)"),
        (character(CUBE[:7], SIDES[:1]), r"no mesh has the 8 points of 'Body' \(there is 'Body' with 7\)"),
        (character(CUBE, SIDES[:4]), "the faces of 'Body' join other points"),
    ],
)
def test_what_is_no_member_is_named(other, told):
    with pytest.raises(SetupError, match=f"'tall.usd' is no member of the family: {told}"):
        member_points(character(), other)


def test_joints_that_move_no_body_may_be_proxies_to_adopt():
    with pytest.raises(SetupError, match=r"1 joint missing \(b\)\. .* Adopt Rig recognises them\. Members have"):
        member_points(character(), character(joints=("a",)))
    weights = np.tile([0.5, 0.5], (len(CUBE), 1))
    bent = replace(character().bodies[0], skin=SkinWeights.from_dense("/Character/Body", weights))
    with pytest.raises(SetupError, match=r"1 joint missing \(b\)\. Members have the same joints"):
        member_points(replace(character(), bodies=(bent,)), character(joints=("a",)))


def test_two_meshes_that_fit_are_told_by_their_names():
    other = character(TALL)
    twin = replace(other.bodies[0], mesh=replace(other.bodies[0].mesh, path="/Character/Twin", points=CUBE + 5))
    both = replace(other, bodies=(twin, *other.bodies))
    np.testing.assert_array_equal(member_points(character(), both)[0], TALL)
    with pytest.raises(SetupError, match="2 meshes could be 'Skin'"):
        member_points(character(name="Skin"), both)


def test_how_much_is_inside_is_told_as_a_share_and_a_depth():
    assert told_inside(np.array([-1.0, 0.0])) == "Nothing is inside the body"
    assert told_inside(np.array([0.002, -1, -1])) == "One vertex is inside the body, 2.0 mm at most"
    assert (
        told_inside(np.array([0.002, 0.0035, -1, -1])) == "50.0% of the vertices are inside the body, 3.5 mm at most"
    )


def choose_keys(garment: Any, **values: float) -> None:
    garment.ssilk.try_on.body = "KEYS"
    garment.ssilk.try_on.keys.clear()
    for name, value in values.items():
        item = garment.ssilk.try_on.keys.add()
        item.key, item.value = name, value


@pytest.fixture
def tried(ready: ModuleType, rigged: Any, folder: Path) -> Any:
    """The rigged skirt, tried on the pillar with a shape key that makes it wider, from a file."""
    path = folder / "tried.blend"
    if not opened(ready, path):
        fuller(ready.data.objects["Pillar"], amount=0.5)
        choose_keys(rigged, Full=1.0)
        assert ready.ops.ssilk.try_on() == {"FINISHED"}
        ready.ops.wm.save_as_mainfile(filepath=str(path))
        opened(ready, path)
    activate(ready, ready.data.objects["Skirt"])
    return ready.data.objects["Skirt"]


def copies(garment: Any) -> dict[str, Any]:
    from blender_addon.quality.tried_on import find

    return {copy["ssilk_role"]: copy for copy in find(garment).instance_collection.objects}


def shown_at(bpy: ModuleType, garment: Any, share: float) -> dict[str, np.ndarray]:
    """What Blender evaluates of each copy at a share, (V, 3), without the way to the side."""
    garment.ssilk.try_on.share = share
    graph = bpy.context.evaluated_depsgraph_get()
    found = {}
    for instance in graph.object_instances:
        role = instance.object.get("ssilk_role") if instance.is_instance else None
        if role:
            points = np.empty(3 * len(instance.object.data.vertices), dtype=np.float32)
            instance.object.data.vertices.foreach_get("co", points)
            found[role] = points.reshape(-1, 3)
    return found


def member_stage(bpy: ModuleType, garment: Any, folder: Path, **values: float) -> Any:
    """Hand the garment over with these values of the pillar's keys, which are taken back."""
    from blender_addon.scene.garment import armature_of
    from blender_addon.scene.gather import gather
    from blender_addon.scene.handover import hand_over
    from blender_addon.scene.objects import Pair

    folder.mkdir(exist_ok=True)
    blocks = bpy.data.objects["Pillar"].data.shape_keys.key_blocks
    for name, value in values.items():
        blocks[name].value = value
    handed = hand_over(gather(garment), Pair.of(garment, armature_of(garment)), folder)
    for name in values:
        blocks[name].value = 0.0
    return handed


def test_it_lies_as_ssilk_rig_puts_it_onto_that_body(ready, tried, tmp_path, ssilk_python):
    own, other = (
        member_stage(ready, tried, tmp_path / name, Full=value) for name, value in (("own", 0), ("other", 1.0))
    )
    words = ["rig", own.stage, "--garment", own.prim, "--onto", other.stage, "--keep-shape", "-o"]
    command = [ssilk_python, "-m", "ssilk_core", *map(str, words), str(own.stage.parent / "rigged.usdc")]
    subprocess.run(command, check=True, capture_output=True)
    garment, rig = own.rig(own.stage.parent)
    units, start = own.scene.units, units_points(own)
    wanted = units.points_from_core(garment.mesh.points)
    assert np.linalg.norm(wanted - start, axis=1).max() > 0.05
    shown = shown_at(ready, tried, 1.0)
    assert np.abs(shown["cloth"] - wanted).max() < EXACT
    heads = units.points_from_core(rig.bind_transforms[:, :3, 3])
    assert np.abs(shown["proxies"][: len(heads)] - heads).max() < EXACT
    # Here the way from body to body is straight for the cloth, too, wherever nothing is to be settled.
    between = shown_at(ready, tried, 0.3)
    pillar = units.points_from_core(own.scene.character.bodies[0].mesh.points)
    assert np.abs(between["body"] - pillar * (1.15, 1.15, 1)).max() < EXACT
    assert np.abs(between["cloth"] - (0.7 * start + 0.3 * wanted)).max() < 2e-3
    assert np.abs(shown_at(ready, tried, 0.0)["cloth"] - start).max() < EXACT
    beyond = shown_at(ready, tried, 1.25)
    assert np.abs(beyond["body"] - pillar * (1.625, 1.625, 1)).max() < EXACT


def units_points(handed: Any) -> np.ndarray:
    return handed.scene.units.points_from_core(handed.scene.garment.mesh.points)


def test_a_stage_of_that_body_shows_the_same(ready, tried, tmp_path):
    wanted = {share: shown_at(ready, tried, share) for share in (-0.25, 0.5, 1.0)}
    stage = member_stage(ready, tried, tmp_path / "other", Full=1.0).stage
    tried.ssilk.try_on.body, tried.ssilk.try_on.stage = "STAGE", str(stage)
    # It is found where the artist has put the character.
    for name in ("Rig", "Skirt", "Pillar"):
        ready.data.objects[name].location.x += 2.0
    assert ready.ops.ssilk.try_on() == {"FINISHED"}
    for share, points in wanted.items():
        for role, there in shown_at(ready, tried, share).items():
            assert np.abs(there - (2, 0, 0) - points[role]).max() < 10 * EXACT, (share, role)
    assert sum(thing.get("ssilk_tried_on") is not None for thing in ready.data.objects) == 1
    tried.ssilk.try_on.stage = f"{stage}:Full=1"  # keys were applied
    with pytest.raises(RuntimeError, match="its bodies have no blendshapes"):
        ready.ops.ssilk.try_on()


def state_of(bpy: ModuleType) -> list[Any]:
    """All that other operators take of the skirt, and what stands in the view layer besides what shows it."""
    from blender_addon.scene.garment import bodies_of, garments_of
    from blender_addon.scene.gather import gather

    garment = bpy.data.objects["Skirt"]
    rig, scene = bpy.data.objects["Rig"], gather(garment)
    keys = bpy.data.objects["Pillar"].data.shape_keys.key_blocks
    arrays = [mesh.points.tobytes() for mesh in scene.meshes.values()]
    arrays += [part.tobytes() for part in (scene.rig.skin.weights, scene.rig.bind_transforms, scene.garment.classes)]
    things = sorted(thing.name for thing in bpy.context.view_layer.objects if thing.type != "EMPTY")
    others = [thing.name for thing in (*bodies_of(garment, rig), *garments_of(rig))]
    return [*arrays, [key.value for key in keys], things, others, garment.data.shape_keys is None]


def test_other_operators_do_not_see_it_and_stop_leaves_nothing(ready, tried):
    kinds = (ready.data.objects, ready.data.meshes, ready.data.shape_keys, ready.data.collections)
    with_it = state_of(ready)
    counts = [len(kind) for kind in kinds]
    assert ready.ops.ssilk.stop_trying_on() == {"FINISHED"}
    assert state_of(ready) == with_it
    # The empty and three copies; the key of the pillar stays.
    assert [before - len(kind) for before, kind in zip(counts, kinds)] == [4, 3, 3, 1]
    assert not ready.ops.ssilk.stop_trying_on.poll()


def test_slider_and_copies_are_undone_together(ready, tried):
    ready.ops.ed.undo_push(message="before")
    before = shown_at(ready, tried, 1.0)["cloth"]
    ready.ops.ed.undo_push(message="at one")
    shown_at(ready, tried, 0.0)
    ready.ops.ed.undo_push(message="at none")
    assert ready.ops.ssilk.stop_trying_on() == {"FINISHED"}
    ready.ops.ed.undo_push(message="stopped")
    ready.ops.ed.undo()
    assert ready.data.objects["Skirt"].ssilk.try_on.share == 0.0
    assert copies(ready.data.objects["Skirt"])["cloth"].data.shape_keys.key_blocks["1"].value == 0.0
    ready.ops.ed.undo()
    assert ready.data.objects["Skirt"].ssilk.try_on.share == 1.0
    assert copies(ready.data.objects["Skirt"])["cloth"].data.shape_keys.key_blocks["1"].value == 1.0
    assert np.array_equal(shown_at(ready, ready.data.objects["Skirt"], 1.0)["cloth"], before)


def test_the_panel_tells_what_is_inside_and_what_has_changed(ready, tried):
    from blender_addon.panels import TryOnPanel

    tried.ssilk.try_on.share = 1.0
    notes = drawn(TryOnPanel, ready.context)
    assert {"body", "key", "value", "ssilk.try_on", "ssilk.stop_trying_on", "share"} <= set(notes)
    assert "Nothing is inside the body" in notes and "changed since" not in " ".join(notes)
    # Cloth that lies along the axis of the pillar, 225 mm wide there, is as deep inside.
    key = copies(tried)["cloth"].data.shape_keys.key_blocks["1"]
    for point in key.data:
        point.co.x = point.co.y = 0.0
    tried.ssilk.try_on.share = 0.999
    told = " ".join(drawn(TryOnPanel, ready.context))
    assert "100.0% of the vertices are inside the body, 22" in told
    tried.data.vertices[0].co.x += 0.01
    assert "has changed since; try it on again" in " ".join(drawn(TryOnPanel, ready.context))


def pin(thing: Any) -> None:
    thing.active_shape_key_index, thing.show_only_shape_key = 1, True


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda garment, pillar: choose_keys(garment), "No shape key is chosen"),
        (lambda garment, pillar: choose_keys(garment, Slim=1.0), r"shape key 'Slim' \(there is 'Full'\)"),
        (lambda garment, pillar: choose_keys(garment, Full=0.0), "have these values of their shape keys already"),
        (lambda garment, pillar: setattr(garment.ssilk.try_on.keys.add(), "key", "Full"), "chosen twice; remove one"),
        (lambda garment, pillar: pin(pillar), "'Pillar' shows one shape key alone"),
        (lambda garment, pillar: setattr(garment.ssilk.try_on, "body", "STAGE"), "There is no file"),
    ],
)
def test_bodies_that_cannot_be_made_are_refused_and_nothing_is_left(ready, skirt, change, told):
    pillar = ready.data.objects["Pillar"]
    fuller(pillar)
    choose_keys(skirt, Full=1.0)
    change(skirt, pillar)
    before = [len(kind) for kind in (ready.data.objects, ready.data.meshes, ready.data.shape_keys)]
    with pytest.raises(RuntimeError, match=told):
        ready.ops.ssilk.try_on()
    assert [len(kind) for kind in (ready.data.objects, ready.data.meshes, ready.data.shape_keys)] == before


def test_modifiers_and_drivers_that_shape_a_body_are_heeded(bpy, skirt):
    """A mirrored half with a key that a driver holds: the other body is mirrored, too, and has the key's value."""
    from blender_addon.scene.gather import gather
    from blender_addon.scene.other_bodies import names_of_keys, points_with_keys

    pillar = bpy.data.objects["Pillar"]
    fuller(pillar, amount=1.0).driver_add("value").driver.expression = "0.25"
    pillar.modifiers.new("Mirror", "MIRROR").use_axis = (False, False, True)
    pillar.modifiers["Mirror"].use_mirror_merge = False
    pillar.modifiers.move(1, 0)
    bpy.context.view_layer.update()
    assert names_of_keys(skirt) == ["Full"]
    scene = gather(skirt)
    (points,) = points_with_keys(skirt, scene, {"Full": 1.0})
    own = scene.character.bodies[0].mesh.points
    assert len(own) == 2 * len(pillar.data.vertices)
    np.testing.assert_allclose(points, own * (2 / 1.25, 1, 2 / 1.25), atol=1e-5)


def test_copies_of_mirrored_objects_face_outward_and_modifiers_count(bpy, skirt):
    from blender_addon.quality.tried_on import TriedOn, mark_of, show
    from blender_addon.scene.gather import gather
    from blender_addon.scene.meshes import triangles_of

    bpy.data.objects["Pillar"].modifiers.new("Subdivision", "SUBSURF").levels = 1
    bpy.data.objects["Pillar"].modifiers.move(1, 0)
    skirt.scale.x = -1.0
    bpy.context.view_layer.update()
    scene = gather(skirt)
    cloth, body = (mesh for mesh in scene.meshes.values())
    there = np.stack([cloth.points * (1 + knot, 1, 1) for knot in KNOTS])
    tried = TriedOn("a body", mark_of(skirt), there, [body.points * (2, 1, 1)], np.zeros((4, 0, 3)))
    show(skirt, scene, tried)
    found = shown_at(bpy, skirt, 1.0)
    assert set(found) == {"cloth", "body"} and len(found["body"]) == body.vertex_count
    for role, mesh in (("cloth", cloth), ("body", body)):
        np.testing.assert_allclose(found[role], scene.units.points_from_core(mesh.points * (2, 1, 1)), atol=1e-6)
        a, b, c = np.moveaxis(found[role][triangles_of(copies(skirt)[role].data)], 1, 0)
        assert np.einsum("ti,ti->", np.cross(b - a, c - a), (a + b + c) * (1, 1, 0)) > 0


def test_with_a_window_what_is_inside_is_measured_once_the_slider_rests(ready, tried, monkeypatch):
    from blender_addon.quality import tried_on

    waiting: list[Any] = []
    timers = SimpleNamespace(
        is_registered=waiting.__contains__,
        register=lambda what, **_: waiting.append(what),
        unregister=waiting.remove,
    )
    app = SimpleNamespace(background=False, timers=timers)
    window = SimpleNamespace(app=app, data=ready.data, context=ready.context, types=ready.types)
    monkeypatch.setattr(tried_on, "bpy", window)
    tried.ssilk.try_on.share = 0.2
    assert "once the slider rests" in tried_on.inside_line(tried)
    tried.ssilk.try_on.share = 0.4
    assert "once the slider rests" in tried_on.inside_line(tried)
    (measure,) = waiting
    tried.ssilk.try_on.share = 0.6
    assert measure() == tried_on.PATIENCE  # it moved since
    assert measure() is None
    assert tried_on.inside_line(tried) == "Nothing is inside the body"


def test_the_path_of_the_stage_stays_true_in_another_folder(bpy, skirt, tmp_path):
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "one" / "a.blend"))
    skirt.ssilk.try_on.stage = "//tall.usdc"
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "two" / "a.blend"))
    assert Path(bpy.path.abspath(skirt.ssilk.try_on.stage)).resolve() == (tmp_path / "one" / "tall.usdc").resolve()


def test_keys_are_added_to_the_list_and_removed(bpy, skirt):
    bpy.ops.ssilk.add_body_key()
    bpy.ops.ssilk.add_body_key()
    skirt.ssilk.try_on.keys[1].key = "Full"
    bpy.ops.ssilk.remove_body_key(index=0)
    assert [item.key for item in skirt.ssilk.try_on.keys] == ["Full"]
