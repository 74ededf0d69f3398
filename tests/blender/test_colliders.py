# SPDX-License-Identifier: Apache-2.0
"""Colliders: what live playback sees of Blender's meshes is what bakes see of them."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from .conftest import activate, add_mesh
from .scenes import shown

EXACT = 2e-5  # [m], between live playback and a bake
SEEN = 1e-5  # of what Blender's Python and libigl see of colliders
FRAMES = range(1, 41)
SEEING = """
import sys
from dataclasses import replace
import numpy as np
from ssilk_core.network.checkpoint import load_model, save_model
from ssilk_core.network.parameters import seeing_more
from ssilk_core.network.proximity import proximity_size
file, rng = load_model(sys.argv[1]), np.random.default_rng(5)
config = replace(file.config, proximity_points=12)
features = proximity_size(file.scene, config)
seeing = seeing_more(file.parameters, file.scene, file.config, config)
for name, more in seeing.items():
    if more.shape != file.parameters[name].shape:
        blank = (more == 0).all(axis=0)
        assert blank.sum() == features
        more[:, blank] = rng.normal(0, 0.3, (len(more), features)).astype(more.dtype)
save_model(sys.argv[2], replace(file, config=config, parameters=seeing))
"""
PROXIMITY = """
import sys
import numpy as np
from ssilk_core.delivery.bake import BakeRequest, load_rollout
model, stage, motion, output = sys.argv[1:]
near = load_rollout(BakeRequest(model=model, stage=stage, motion=motion)).source.proximity
np.save(output, np.zeros(0) if near is None else near)
"""


@pytest.fixture
def seeing(ready, trained, ssilk_python) -> Any:
    """The trained skirt with a model that colliders move, too."""
    from blender_addon.playback.models import model_of

    before = model_of(trained)
    path = before.with_name("seeing.safetensors")
    if not path.exists():
        subprocess.run([ssilk_python, "-c", SEEING, str(before), str(path)], check=True)
    trained.ssilk.model = str(path)
    return trained


def collide(ready: Any, garment: Any, thing: Any) -> Any:
    """Give an object Collision physics."""
    thing.modifiers.new("Collision", "COLLISION")
    ready.context.view_layer.update()
    activate(ready, garment)
    return thing


def a_floor(ready: Any, garment: Any) -> Any:
    ready.ops.mesh.primitive_plane_add(size=100, location=(3, 2, 0.62))
    return collide(ready, garment, ready.context.object)


def a_box_that_moves(ready: Any, garment: Any) -> Any:
    ready.ops.mesh.primitive_cube_add(size=0.5, location=(0.9, 0.1, 0.9), scale=(1, 0.6, 2))
    box = ready.context.object
    box.keyframe_insert("location", frame=1)
    box.keyframe_insert("rotation_euler", frame=1)
    box.location, box.rotation_euler = (0.2, -0.1, 1.0), (0.4, 0.9, 1.3)
    box.keyframe_insert("location", frame=40)
    box.keyframe_insert("rotation_euler", frame=40)
    return collide(ready, garment, box)


def a_box_that_grows(ready: Any, garment: Any) -> Any:
    box = a_box_that_moves(ready, garment)
    box.keyframe_insert("scale", frame=1)
    box.scale = (-1.4, 0.6, 2)
    box.keyframe_insert("scale", frame=40)
    return box


def a_wall(ready: Any, garment: Any) -> Any:
    """Open, of many faces, mirrored and turned."""
    ready.ops.mesh.primitive_grid_add(x_subdivisions=9, y_subdivisions=7, size=2, location=(-0.5, 0, 1.1))
    wall = ready.context.object
    wall.rotation_euler, wall.scale = (0.3, np.pi / 2 - 0.1, 0.2), (-0.7, 1, 1)
    return collide(ready, garment, wall)


def a_sea(ready: Any, garment: Any) -> Any:
    """A grid that waves, finer by a modifier, and switched off for a while."""
    ready.ops.mesh.primitive_grid_add(x_subdivisions=12, y_subdivisions=12, size=4, location=(0.2, 0, 0.7))
    sea = ready.context.object
    wave = sea.modifiers.new("Wave", "WAVE")
    wave.height, wave.width, wave.time_offset = 0.3, 0.8, -40
    sea.modifiers.new("Finer", "SUBSURF").levels = 1
    collide(ready, garment, sea)
    for frame, on in ((1, True), (11, False), (21, True)):
        sea.collision.use = on
        sea.keyframe_insert("collision.use", frame=frame)
    ready.context.scene.frame_set(1)
    return sea


def near_live(garment: Any) -> np.ndarray | None:
    from blender_addon.playback import playing

    return playing.live(garment).rolled.near


def live(ready: Any, garment: Any) -> tuple[np.ndarray, np.ndarray | None]:
    """Return what is shown in all frames, (F, V, 3), and how near colliders are, (F, M, 5)."""
    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    near = near_live(garment)
    found = shown(ready, garment, FRAMES)
    assert ready.ops.ssilk.stop_live() == {"FINISHED"}
    return found, near


def near_in_bake(python: str, garment: Any, folder: Path) -> np.ndarray:
    from blender_addon.playback.models import model_of

    model, output = model_of(garment), folder / "near.npy"
    words = [model, model.parent / "dressed.usdc", model.parent / "bake" / "motion.usdc", output]
    subprocess.run([python, "-c", PROXIMITY, *map(str, words)], check=True)
    return np.load(output)


@pytest.mark.parametrize("made", [a_floor, a_box_that_moves, a_box_that_grows, a_wall, a_sea])
def test_live_playback_sees_and_shows_what_a_bake_does(ready, seeing, ssilk_python, tmp_path, made):
    alone, none = live(ready, seeing)
    assert none is None
    made(ready, seeing)
    met, near = live(ready, seeing)
    assert np.abs(met - alone).max() > 1e-3 and near[..., 3].min() < 0.1
    if made is a_sea:
        off = (near[..., :3] == 0).all(axis=(1, 2))
        assert off[10:20].all() and not off[:10].any() and not off[20:].any()
    assert ready.ops.ssilk.bake() == {"FINISHED"}
    np.testing.assert_allclose(near_in_bake(ssilk_python, seeing, tmp_path), near, atol=SEEN)
    assert np.abs(shown(ready, seeing, FRAMES) - met).max() < EXACT


def a_prop_in_no_scene(ready: Any, garment: Any) -> Any:
    """A hidden sphere of a chosen collection, in centimetres and without physics, that appears in frame 20."""
    ready.ops.mesh.primitive_uv_sphere_add(segments=12, ring_count=8, radius=30, location=(0.6, 0, 0.8))
    ball = ready.context.object
    ball.scale = (0.01, 0.01, 0.01)
    for collection in ball.users_collection:
        collection.objects.unlink(ball)
    garment.ssilk.colliders = ready.data.collections.new("Props")
    garment.ssilk.colliders.objects.link(ball)
    for frame, hidden in ((1, True), (20, False)):
        ball.hide_viewport = hidden
        ball.keyframe_insert("hide_viewport", frame=frame)
    ready.context.view_layer.update()
    activate(ready, garment)
    return ball


def test_a_prop_of_a_chosen_collection_is_met_while_it_is_there(ready, seeing, ssilk_python, tmp_path):
    a_prop_in_no_scene(ready, seeing)
    met, near = live(ready, seeing)
    off = (near[..., :3] == 0).all(axis=(1, 2))
    assert off[:19].all() and not off[19:].any()
    assert ready.ops.ssilk.bake() == {"FINISHED"}
    np.testing.assert_allclose(near_in_bake(ssilk_python, seeing, tmp_path), near, atol=SEEN)
    assert np.abs(shown(ready, seeing, FRAMES) - met).max() < EXACT


def evaluations(ready: Any, do: Any) -> tuple[int, int]:
    """Return how often Blender evaluates another frame while something is done, and how often it updates one."""
    counts = [0, 0]
    handlers = ready.app.handlers

    def frame(*_: Any) -> None:
        counts[0] += 1

    def update(*_: Any) -> None:
        counts[1] += 1

    handlers.frame_change_post.append(frame)
    handlers.depsgraph_update_post.append(update)
    try:
        do()
    finally:
        handlers.frame_change_post.remove(frame)
        handlers.depsgraph_update_post.remove(update)
    return counts[0], counts[1]


def test_colliders_cost_nothing_where_none_is_there_or_none_is_seen(ready, seeing):
    """Bit by bit, file by file, and frame by frame of Blender's."""
    from blender_addon.playback.models import model_of

    path, found, files, counts = seeing.ssilk.model, {}, {}, {}
    motion = model_of(seeing).parent / "bake" / "motion.usdc"
    for around in (False, True):
        if around:
            a_floor(ready, seeing)
        for model in ("", path):
            seeing.ssilk.model = model
            key = around, bool(model)
            ready.context.view_layer.update()  # what was changed here
            counts[key] = evaluations(ready, lambda key=key: found.setdefault(key, live(ready, seeing)))
            if key != (True, True):
                assert found[key][1] is None
            assert ready.ops.ssilk.bake() == {"FINISHED"}
            files[key] = motion.read_bytes()
    np.testing.assert_array_equal(found[True, False][0], found[False, False][0])
    assert files[True, False] == files[False, False] == files[False, True] != files[True, True]
    assert counts[True, False] == counts[False, False] == counts[False, True]
    # Once in each frame; and to one and back, in which a floor is told from what is inside the body.
    assert counts[True, True][0] == counts[False, False][0] + len(FRAMES) + 2


def test_panels_name_the_colliders_that_are_not_seen(ready, seeing):
    from blender_addon.panels.playback import unseen_line, unsolved_line

    path = seeing.ssilk.model
    assert unseen_line(seeing) == unsolved_line(seeing) == ""
    floor = a_floor(ready, seeing).name
    assert unseen_line(seeing) == unsolved_line(seeing) == ""
    seeing.ssilk.live_quality = "latent"
    missed = f"does not see 1 collider, '{floor}'; a bake as Hero meets them"
    assert (unseen_line(seeing), unsolved_line(seeing)) == ("", f"The solver in latents {missed}")
    seeing.ssilk.live_quality, seeing.ssilk.model = "NETWORK", ""
    assert (unseen_line(seeing), unsolved_line(seeing)) == (f"The network {missed}", "")
    seeing.ssilk.model = path + " that is gone"
    assert unseen_line(seeing) == ""


@pytest.mark.parametrize(
    ("quality", "seen", "handed"), [("WHOLE", False, False), ("hero", False, True), ("latent", True, False)]
)
def test_a_bake_meets_colliders_where_its_network_or_its_solver_does(ready, seeing, quality, seen, handed):
    """Of six frames, since the solver takes its time; what is not met is told."""
    from ssilk_usd.opening.stage import open_stage

    from blender_addon.playback.models import model_of

    a_floor(ready, seeing)
    ready.context.scene.frame_end = 6
    seeing.ssilk.model = seeing.ssilk.model if seen else ""
    motion = model_of(seeing).parent / "bake" / "motion.usdc"
    assert ready.ops.ssilk.bake(quality=quality, pre_roll=0.0) == {"FINISHED"}
    assert bool(open_stage(str(motion)).GetPrimAtPath("/Colliders")) == handed


def grows(ready: Any, floor: Any) -> str:
    array = floor.modifiers.new("Array", "ARRAY")
    array.keyframe_insert("count", frame=1)
    array.count = 5
    array.keyframe_insert("count", frame=40)
    return f"Modifiers give '{floor.name}' other faces at frame .* than before"


def is_a_cloth(ready: Any, floor: Any) -> str:
    floor.modifiers.new("Flag", "CLOTH")
    return f"The modifier 'Flag' simulates '{floor.name}', which cloth is to meet"


def is_edges(ready: Any, floor: Any) -> str:
    floor.data.clear_geometry()
    floor.data.from_pydata([(0, 0, 0), (1, 0, 0)], [(0, 1)], [])
    return f"'{floor.name}' has no faces that cloth could meet"


@pytest.mark.parametrize("change", [grows, is_a_cloth, is_edges])
def test_what_cannot_be_a_collider_is_refused_in_one_sentence(ready, seeing, change):
    said = change(ready, a_floor(ready, seeing))
    with pytest.raises(RuntimeError, match=said):
        ready.ops.ssilk.play_live()
    with pytest.raises(RuntimeError, match=said):
        ready.ops.ssilk.bake()


def test_nearest_points_are_those_of_all_triangles(bpy):
    """Of two triangles of 100 m, and of a crumpled ball far from the origin, to what double precision allows."""
    from blender_addon.motions.nearest import on_triangles, tree_nearest

    rng = np.random.default_rng(2)
    quad = np.array([[-50, 0, -50], [50, 0, -50], [50, 0, 50], [-50, 0, 50]], dtype=float)
    ball = rng.normal(size=(300, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True) * rng.uniform(1, 1.2, (300, 1))
    crumpled = rng.integers(0, 300, (500, 3))
    crumpled = crumpled[(crumpled != np.roll(crumpled, 1, axis=1)).all(axis=1)]
    for points, faces in ((quad, np.array([[0, 1, 2], [0, 2, 3]])), (ball + 200, crumpled)):
        queries = points.mean(axis=0) + rng.uniform(-2, 2, (400, 3))
        queries[:100, 2] += queries[:100, 0] - queries[:100, 2] + 1e-3 * rng.normal(size=100)  # by the diagonal
        squares, face, found = tree_nearest(points, faces)(queries)
        every = [on_triangles(np.tile(points[each], (400, 1, 1)), queries)[0] for each in faces]
        np.testing.assert_allclose(np.sqrt(squares), np.sqrt(np.min(every, axis=0)), atol=1e-9)
        np.testing.assert_allclose(np.linalg.norm(queries - found, axis=1), np.sqrt(squares), atol=1e-9)
        np.testing.assert_allclose(on_triangles(points[faces[face]], found)[0], 0, atol=1e-12)


def colliders(garment: Any) -> list[str]:
    from blender_addon.motions.colliders import colliders_of
    from blender_addon.scene.garment import armature_of

    return [thing.name for thing in colliders_of(garment, armature_of(garment))]


def test_bodies_garments_and_what_is_off_are_no_colliders(ready, seeing):
    """A chosen collection counts without physics; what stands in it and is no mesh is told."""
    from blender_addon.motions.colliders import unmet

    collide(ready, seeing, ready.data.objects["Pillar"])
    collide(ready, seeing, seeing)
    floor = a_floor(ready, seeing)
    assert colliders(seeing) == [floor.name]
    floor.collision.use = False
    assert colliders(seeing) == []
    floor.collision.use, floor.modifiers["Collision"].show_viewport = True, False
    assert colliders(seeing) == []
    chosen = ready.data.collections.new("Props")  # which no scene has
    chosen.objects.link(floor)
    curve = ready.data.objects.new("Rail", ready.data.curves.new("Rail", "CURVE"))
    chosen.objects.link(curve)
    chosen.objects.link(ready.data.objects["Pillar"])
    seeing.ssilk.colliders = chosen
    assert colliders(seeing) == [floor.name]
    assert unmet(seeing) == ["'Rail' is no mesh, and cloth does not meet it; convert it (Object > Convert)"]
    other = add_mesh(ready, "Other Skirt", np.eye(3), np.array([[0, 1, 2]]))
    other.ssilk.armature = ready.data.objects["Rig"]
    chosen.objects.link(other)
    brooch = add_mesh(ready, "Brooch", np.eye(3), np.array([[0, 1, 2]]))
    collide(ready, seeing, brooch)
    assert colliders(seeing) == ["Brooch", floor.name]
    brooch.parent = seeing
    assert colliders(seeing) == [floor.name]
    floor.hide_viewport = True
    assert colliders(seeing) == []


def test_what_carries_a_body_of_chosen_bodies_is_a_collider_where_it_is_named(ready, seeing):
    """A mesh of the character that is none of its chosen bodies counts where the artist says so, and else not."""
    pillar = ready.data.objects["Pillar"]
    shell = ready.data.objects.new("Shell", pillar.data.copy())
    ready.context.collection.objects.link(shell)
    shell.modifiers.new("Armature", "ARMATURE").object = ready.data.objects["Rig"]
    collide(ready, seeing, shell)
    bodies = ready.data.collections.new("Bodies")
    bodies.objects.link(pillar)
    assert colliders(seeing) == []
    seeing.ssilk.bodies = bodies
    assert colliders(seeing) == []
    seeing.ssilk.colliders = ready.data.collections.new("Props")
    seeing.ssilk.colliders.objects.link(shell)
    assert colliders(seeing) == ["Shell"]


def played(garment: Any) -> Any:
    from blender_addon.playback import playing

    return playing.live(garment)


def moved_by_hand(ready: Any, box: Any) -> None:
    box.location.x -= 0.1


def edited(ready: Any, box: Any) -> None:
    for vertex in box.data.vertices:
        vertex.co.x *= 1.2
    box.data.update()


def otherwise_modified(ready: Any, box: Any) -> None:
    box.modifiers["Displace"].strength = 0.1


def another(ready: Any, box: Any) -> None:
    ready.ops.mesh.primitive_plane_add(size=4, location=(0, 0, 0.5))
    ready.context.object.modifiers.new("Collision", "COLLISION")
    ready.context.object.select_set(False)


def deleted(ready: Any, box: Any) -> None:
    ready.data.objects.remove(box)


def switched_off(ready: Any, box: Any) -> None:
    box.collision.use = False


@pytest.mark.parametrize("change", [moved_by_hand, edited, otherwise_modified, another, deleted, switched_off])
def test_a_change_of_a_collider_is_noticed_and_read(ready, seeing, change):
    box = a_box(ready, seeing)
    ready.context.scene.frame_set(5)
    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    before = near_live(seeing)
    ready.context.view_layer.update()
    ready.context.scene.frame_set(6)
    assert not played(seeing).stale and not played(seeing).behind
    change(ready, box)
    ready.context.view_layer.update()
    assert played(seeing).stale or played(seeing).behind
    activate(ready, seeing)
    assert ready.ops.ssilk.refresh_live() == {"FINISHED"}
    ready.context.scene.frame_set(7)
    assert not played(seeing).stale and not played(seeing).behind
    now = near_live(seeing)
    assert now is None if change in (deleted, switched_off) else np.abs(now - before).max() > 1e-3
    assert ready.ops.ssilk.stop_live() == {"FINISHED"}


def a_box(ready: Any, garment: Any) -> Any:
    ready.ops.mesh.primitive_cube_add(size=0.4, location=(0.7, 0.1, 0.9))
    box = ready.context.object
    box.modifiers.new("Displace", "DISPLACE").strength = 0.01
    return collide(ready, garment, box)


def test_a_keyed_collider_that_is_dragged_is_read_again_once(ready, seeing):
    """What keys take back differs from what was read for as long as it is dragged: it is no reason to read on."""
    box = a_box_that_moves(ready, seeing)
    ready.context.scene.frame_set(5)
    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    box.location.x += 0.3
    ready.context.view_layer.update()
    assert played(seeing).stale
    assert ready.ops.ssilk.refresh_live() == {"FINISHED"}
    assert not played(seeing).stale
    box.update_tag()
    ready.context.view_layer.update()
    assert not played(seeing).stale
    ready.context.scene.frame_set(6)
    assert not played(seeing).stale
    assert ready.ops.ssilk.stop_live() == {"FINISHED"}


def test_a_pose_that_differs_is_seen_by_colliders_where_it_is(ready, seeing):
    """As an artist poses the hips during playback: the frame's own distances are measured again."""
    a_wall(ready, seeing)
    ready.context.scene.frame_set(5)
    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    before = near_live(seeing)
    hips = ready.data.objects["Rig"].pose.bones["Hips"]
    hips.location.x += 0.2
    ready.context.view_layer.update()
    play = played(seeing)
    play.show(ready.context.scene, ready.context.evaluated_depsgraph_get())
    now = near_live(seeing)
    assert np.abs(now[4] - before[4]).max() > 1e-2
    np.testing.assert_array_equal(np.delete(now, 4, axis=0), np.delete(before, 4, axis=0))
    assert ready.ops.ssilk.stop_live() == {"FINISHED"}


def a_shape_of_the_body(ready: Any, garment: Any) -> Any:
    """A cylinder that collides and rides on the character's root bone, inside its body, as a ragdoll's shapes do."""
    armature = garment.find_armature()
    bone = next(bone for bone in armature.pose.bones if not bone.parent)
    ready.ops.mesh.primitive_cylinder_add(radius=0.06, depth=0.2, location=armature.matrix_world @ bone.center)
    shape = ready.context.object
    world = shape.matrix_world.copy()
    shape.parent, shape.parent_type, shape.parent_bone = armature, "BONE", bone.name
    ready.context.view_layer.update()
    shape.matrix_world = world
    return collide(ready, garment, shape)


def inside_body(ready: Any, shape: Any, body: Any) -> list[float]:
    """Return for some frames the share of a shape's vertices inside the body, both as Blender evaluates them."""
    from mathutils import Vector

    found = []
    for frame in FRAMES[::13]:
        ready.context.scene.frame_set(frame)
        depsgraph = ready.context.evaluated_depsgraph_get()
        skin, own = body.evaluated_get(depsgraph), shape.evaluated_get(depsgraph)
        to_skin = skin.matrix_world.inverted() @ own.matrix_world
        hits = []
        for vertex in own.data.vertices:
            at, crossed = to_skin @ vertex.co, 0
            while (hit := skin.ray_cast(at, Vector((0.9, 0.3, 0.05))))[0]:
                crossed, at = crossed + 1, hit[1] + 1e-4 * Vector((0.9, 0.3, 0.05))
            hits.append(crossed % 2)
        found.append(float(np.mean(hits)))
    ready.context.scene.frame_set(1)
    return found


def test_a_shape_inside_the_body_is_its_own_in_live_playback_and_in_bakes_unless_it_is_chosen(ready, seeing, capfd):
    from blender_addon.playback import playing
    from blender_addon.scene.garment import bodies_of

    alone, _ = live(ready, seeing)
    shape = a_shape_of_the_body(ready, seeing)
    (body,) = bodies_of(seeing, seeing.find_armature())
    assert min(inside_body(ready, shape, body)) > 0.9
    assert ready.ops.ssilk.play_live() == {"FINISHED"}
    assert playing.live(seeing).colliders.own == (shape.name,)
    assert ready.ops.ssilk.stop_live() == {"FINISHED"}
    with_it, near = live(ready, seeing)
    assert near is None and np.abs(with_it - alone).max() < EXACT
    capfd.readouterr()
    assert ready.ops.ssilk.bake() == {"FINISHED"}
    assert f"cloth does not meet '{shape.name}', inside the body in each frame." in capfd.readouterr().out
    assert np.abs(shown(ready, seeing, FRAMES) - alone).max() < EXACT
    seeing.ssilk.colliders = ready.data.collections.new("Chosen")
    seeing.ssilk.colliders.objects.link(shape)
    chosen, near = live(ready, seeing)
    assert near is not None and near[..., :3].any()
    assert ready.ops.ssilk.bake() == {"FINISHED"}
    assert "does not meet" not in capfd.readouterr().out
    assert np.abs(shown(ready, seeing, FRAMES) - chosen).max() < EXACT
