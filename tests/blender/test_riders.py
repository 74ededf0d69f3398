# SPDX-License-Identifier: Apache-2.0
"""What rides on a garment in Blender: it follows the cloth live and baked, and is so in USD and in glTF."""

from __future__ import annotations

import re
import subprocess
from math import radians

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from blender_addon.scene.riders import riders_of

from .conftest import activate, add_mesh, tube
from .scenes import shown

FRAMES = range(1, 13)
ALLOWED = 1e-3  # [m] of a rider from its cloth
EXACT = 2e-5  # [m]


def brooch(bpy, garment, *, face: int = 200, name: str = "Brooch", away: float = 0.002):
    """Return a disc of 20 mm on a face of a garment, as it is shown, and attach it."""
    thing = add_mesh(bpy, name, *tube(12, 3, (0.0, 0.004), (0.02, 0.02)))
    polygon = garment.data.polygons[face]
    world = garment.matrix_world
    normal = (world.to_3x3() @ polygon.normal).normalized()
    thing.rotation_mode = "QUATERNION"
    thing.rotation_quaternion = normal.to_track_quat("Z", "X")
    thing.location = world @ polygon.center + away * normal
    bpy.context.view_layer.update()
    return thing


def attach(bpy, garment, *riders) -> None:
    activate(bpy, garment)
    for rider in riders:
        rider.select_set(True)
    assert bpy.ops.ssilk.attach_to_cloth() == {"FINISHED"}
    activate(bpy, garment)


@pytest.fixture
def worn(ready, trained):
    """The skirt, with a brooch attached to it, over a few frames."""
    ready.context.scene.frame_end = FRAMES.stop - 1
    rider = brooch(ready, trained)
    before = rider.matrix_world.copy()
    attach(ready, trained, rider)
    assert np.abs(np.array(rider.matrix_world) - np.array(before)).max() < 1e-5  # it stays where it is
    return rider


def place_on(cloth: np.ndarray, rider: np.ndarray) -> np.ndarray:
    """Return where the middle of a rider (F, M, 3) is on a triangle (F, 3, 3), by its axes [m], shape (F, 3)."""
    along, other = cloth[:, 1] - cloth[:, 0], cloth[:, 2] - cloth[:, 0]
    up = np.cross(along, other)
    along, up = (each / np.linalg.norm(each, axis=1, keepdims=True) for each in (along, up))
    axes = np.stack([along, np.cross(up, along), up], axis=1)
    return np.einsum("fac,fc->fa", axes, rider.mean(axis=1) - cloth.mean(axis=1))


def test_a_rider_follows_live_playback_and_a_bake(ready, trained, worn):
    still = shown(ready, worn, FRAMES)
    for play in (ready.ops.ssilk.play_live, lambda: ready.ops.ssilk.bake(pre_roll=0.0)):
        assert play() == {"FINISHED"}
        assert np.abs(shown(ready, worn, FRAMES) - still).max() > 0.05  # the cloth moves by itself
        found = place_on(shown(ready, trained, FRAMES)[:, list(worn.parent_vertices)], shown(ready, worn, FRAMES))
        assert np.abs(found - found[0]).max() < EXACT


def in_stage(path, name: str) -> np.ndarray:
    """Return the points of a mesh in all frames of a shot in Blender's world, by UsdSkel, shape (F, V, 3)."""
    from ssilk_usd.shots.play import Shot

    shot = Shot(str(path))
    (index,) = [number for number, mesh in enumerate(shot.meshes) if mesh.name == name]
    return np.array([shot.units.points_from_core(shot.mesh_points(index, time)) for time in shot.frame_times])


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_a_shot_in_usd_has_riders_where_blender_shows_them(ready, trained, worn, folder, ssilk_python, scale, capfd):
    gem = add_mesh(ready, "Gem", *tube(8, 3, (0.0, 0.01), (0.004, 0.004)))  # hangs on the brooch
    gem.parent, gem.location = worn, (0.004, 0.0, 0.005)
    worn.scale = (scale, scale, scale)
    worn.data.materials.append(ready.data.materials.new("Gold"))
    pin = brooch(ready, trained, face=120, name="Pin")
    activate(ready, trained)
    pin.select_set(True)
    trained.select_set(True)
    ready.ops.object.parent_set(type="VERTEX_TRI")  # as artists do
    activate(ready, trained)
    assert riders_of(trained) == [worn, pin]
    shot = folder / "Skirt.usdc"
    assert ready.ops.ssilk.bake(pre_roll=0.0, to_usd=True, to_timeline=True) == {"FINISHED"}
    told = capfd.readouterr().out
    assert "'Brooch' loses the material 'Gold'" in told and "holds the garment and its bodies alone" not in told
    for thing in (trained, worn, gem, pin):
        assert np.abs(in_stage(shot, thing.name) - shown(ready, thing, FRAMES)).max() < 1e-4, thing.name
    verified = subprocess.run([ssilk_python, "-m", "ssilk_core", "verify", str(shot)], capture_output=True, text=True)
    assert verified.returncode == 0, verified.stderr


def test_another_blender_shows_the_shot_and_its_riders_as_they_were(ready, trained, worn, folder):
    assert ready.ops.ssilk.bake(pre_roll=0.0, to_usd=True, to_timeline=True) == {"FINISHED"}
    expected = {name: shown(ready, ready.data.objects[name], FRAMES) for name in ("Skirt", "Brooch")}
    ready.ops.wm.read_homefile(use_empty=True, use_factory_startup=False)
    ready.ops.wm.usd_import(filepath=str(folder / "Skirt.usdc"))
    for name, points in expected.items():
        assert np.abs(shown(ready, ready.data.objects[name], FRAMES) - points).max() < 1e-4


@pytest.mark.parametrize("parented", [False, True])
def test_a_glb_of_blenders_own_exporter_has_riders_where_blender_shows_them(ready, trained, worn, tmp_path, parented):
    assert ready.ops.ssilk.bake(pre_roll=0.0) == {"FINISHED"}
    if parented:
        trained.parent = ready.data.objects["Rig"]
    worn.scale = (2.0, 2.0, 2.0)
    gem = add_mesh(ready, "Gem", *tube(8, 3, (0.0, 0.01), (0.004, 0.004)))
    gem.parent, gem.location = worn, (0.004, 0.0, 0.005)
    activate(ready, trained)
    path = tmp_path / "Skirt.glb"
    assert ready.ops.ssilk.export_gltf(filepath=str(path)) == {"FINISHED"}
    expected = {name: shown(ready, ready.data.objects[name], FRAMES) for name in ("Brooch", "Gem")}
    ready.ops.wm.read_homefile(use_empty=True, use_factory_startup=False)
    ready.ops.import_scene.gltf(filepath=str(path), merge_vertices=True)
    for name in ("Brooch", "Gem"):
        found = shown(ready, ready.data.objects[name], FRAMES)
        # Vertices come in another order, so middles and extents are compared.
        for figure in (np.min, np.max, np.mean):
            away = figure(found, axis=1) - figure(expected[name], axis=1)
            assert np.abs(away).max() < ALLOWED, (name, figure)


def test_what_moves_a_rider_besides_its_cloth_is_told(ready, trained, worn, capfd):
    worn.rotation_mode = "XYZ"
    for frame in (1, 12):
        worn.rotation_euler = (0.0, 0.0, radians(10 * frame))
        worn.keyframe_insert("rotation_euler", frame=frame)
    assert ready.ops.ssilk.bake(pre_roll=0.0, to_usd=True, to_timeline=False) == {"FINISHED"}
    assert "'Brooch': what moves them besides the cloth is not in the shot in USD" in capfd.readouterr().out


def test_a_trim_that_follows_the_cloth_by_a_modifier_is_told_as_left_out(ready, trained, capfd):
    trim = brooch(ready, trained, name="Trim")
    trim.modifiers.new("Follow", "SURFACE_DEFORM").target = trained
    activate(ready, trained)
    assert ready.ops.ssilk.bake(pre_roll=0.0, to_usd=True, to_timeline=False) == {"FINISHED"}
    assert "holds the garment and its bodies alone, without 'Trim' of 'Rig'." in capfd.readouterr().out


def test_what_cannot_ride_is_refused_in_one_sentence(ready, trained):
    def refused(thing) -> str:
        activate(ready, trained)
        thing.select_set(True)
        with pytest.raises(RuntimeError) as error:
            ready.ops.ssilk.attach_to_cloth()
        assert thing.parent_type == "OBJECT"
        return str(error.value)

    far = brooch(ready, trained, away=0.2)
    assert re.search(
        r"'Brooch': it is 18\d mm away from 'Skirt'; a rider lies within 50 mm.* three vertices", refused(far)
    )
    assert "'Pillar' is moved by an Armature modifier" in refused(ready.data.objects["Pillar"])
    near = brooch(ready, trained, name="Near")
    activate(ready, trained)
    far.select_set(True)
    near.select_set(True)
    with pytest.raises(RuntimeError, match="'Brooch': it is"):
        ready.ops.ssilk.attach_to_cloth()
    assert near.parent is None  # all or none
    empty = ready.data.objects.new("Empty", None)
    ready.context.collection.objects.link(empty)
    assert "'Empty' has no mesh" in refused(empty)
    activate(ready, trained)
    assert not ready.ops.ssilk.attach_to_cloth.poll()


def test_riders_survive_saving_and_renaming(ready, trained, worn, tmp_path):
    worn.name, trained.name = "Fibula", "Kilt"
    ready.ops.wm.save_as_mainfile(filepath=str(tmp_path / "saved.blend"))
    ready.ops.wm.open_mainfile(filepath=str(tmp_path / "saved.blend"))
    assert [each.name for each in riders_of(ready.data.objects["Kilt"])] == ["Fibula"]
