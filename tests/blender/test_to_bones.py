# SPDX-License-Identifier: Apache-2.0
"""To Bones: what a simulation in Blender showed is what bones and shape keys show, without the simulation."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from .conftest import activate
from .scenes import animate, shown

FRAMES = range(1, 13)
CLOTH_DYNAMICS = "Cloth Dynamics (Experimental)"


@pytest.fixture
def walking(ready, rigged):
    """The rigged skirt on a moving pillar, with pins and a surface that is refined."""
    bpy = ready
    animate(bpy, bpy.data.objects["Rig"], "Walk", 0.3, FRAMES.stop)
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = FRAMES.start, FRAMES.stop - 1
    pins = rigged.vertex_groups.new(name="Pins")
    pins.add([v.index for v in rigged.data.vertices if v.co.z > 1.0], 1.0, "REPLACE")
    activate(bpy, rigged)
    return rigged


@pytest.fixture
def simulated(walking):
    """The walking skirt with a Cloth modifier that is not baked."""
    cloth = walking.modifiers.new("Cloth", "CLOTH")
    cloth.settings.vertex_group_mass, cloth.settings.quality = "Pins", 3
    cloth.point_cache.frame_start, cloth.point_cache.frame_end = FRAMES.start, FRAMES.stop - 1
    walking.modifiers.new("Smooth", "SUBSURF").show_viewport = True
    return walking


def add_mdd(bpy, garment, path: Path, *, vertex_count: int | None = None):
    """Give a skirt an MDD cache in which its cloth swings about its bones; return the modifier."""
    points = shown(bpy, garment, FRAMES)
    place = np.linalg.inv(np.array(garment.matrix_world))
    points = (points @ place[:3, :3].T + place[:3, 3])[:, :vertex_count]
    swing = np.sin(np.arange(len(FRAMES)) / 2)[:, None] * np.clip(1.0 - points[0, :, 2], 0, None)
    points[..., 0] += 0.3 * swing
    seconds = np.arange(len(FRAMES)) / 24
    head = struct.pack(">2i", *points.shape[:2]) + seconds.astype(">f4").tobytes()
    path.write_bytes(head + points.astype(">f4").tobytes())
    cache = garment.modifiers.new("Cached", "MESH_CACHE")
    cache.cache_format, cache.filepath, cache.frame_start = "MDD", str(path), FRAMES.start
    return cache


def add_alembic(bpy, garment, path: Path):
    """Give a skirt an Alembic cache of what its MDD cache shows, in place of that; return the modifier."""
    mdd = add_mdd(bpy, garment, path.with_suffix(".mdd"))
    activate(bpy, garment)
    assert bpy.ops.wm.alembic_export(
        filepath=str(path), selected=True, start=FRAMES.start, end=FRAMES.stop - 1, as_background_job=False
    ) == {"FINISHED"}
    garment.modifiers.remove(mdd)
    assert bpy.ops.cachefile.open(filepath=str(path)) == {"FINISHED"}
    cache = garment.modifiers.new("Cached", "MESH_SEQUENCE_CACHE")
    cache.cache_file = bpy.data.cache_files[path.name]
    bpy.context.view_layer.update()
    cache.object_path = next(each.path for each in cache.cache_file.object_paths if each.path.endswith("Skirt"))
    return cache


def add_cloth_dynamics(bpy, garment):
    """Give a skirt the cloth that comes with Blender from 5.2 on, not baked; return the modifier."""
    files = Path(bpy.utils.resource_path("LOCAL")) / "datafiles" / "assets" / "nodes"
    essentials = files / "geometry_nodes_dynamics_assets.blend"
    if not essentials.exists():
        pytest.skip(f"Blender {bpy.app.version_string} has no Cloth Dynamics")
    with bpy.data.libraries.load(str(essentials)) as (_, taken):
        taken.node_groups = [CLOTH_DYNAMICS]
    modifier = garment.modifiers.new("Cloth Dynamics", "NODES")
    modifier.node_group = taken.node_groups[0]
    sockets = {
        item.name: item.identifier for item in modifier.node_group.interface.items_tree if hasattr(item, "identifier")
    }
    pins = getattr(modifier.properties.inputs, sockets["Pin Group"])
    pins.type, pins.attribute_name = "ATTRIBUTE", "Pins"
    return modifier


def turned_within_tolerance(bpy, garment, modifier, wanted: np.ndarray) -> None:
    """Turn a skirt into bones, and check that they show what its modifier showed."""
    modifier.show_viewport = False
    plain = shown(bpy, garment, FRAMES)
    modifier.show_viewport = True
    assert np.linalg.norm(wanted - plain, axis=-1).max() > 0.02
    bpy.context.scene.frame_set(5)
    assert bpy.ops.ssilk.to_bones() == {"FINISHED"}
    assert bpy.context.scene.frame_current == 5
    assert not modifier.show_viewport and not modifier.show_render
    away = np.linalg.norm(shown(bpy, garment, FRAMES) - wanted, axis=-1)
    assert np.sqrt((away**2).mean()) <= 1.01e-3 and away.max() <= 5.05e-3


def bake_cloth(bpy, garment) -> None:
    cache = garment.modifiers["Cloth"].point_cache
    with bpy.context.temp_override(scene=bpy.context.scene, active_object=garment, point_cache=cache):
        assert bpy.ops.ptcache.bake(bake=True) == {"FINISHED"}


def vertices(bpy, garment) -> np.ndarray:
    """What Blender shows, without the refined surface."""
    garment.modifiers["Smooth"].show_viewport = False
    found = shown(bpy, garment, FRAMES)
    garment.modifiers["Smooth"].show_viewport = True
    return found


def test_bones_show_what_the_simulation_showed(ready, simulated):
    bake_cloth(ready, simulated)
    simulated.modifiers["Cloth"].show_viewport = False
    plain = vertices(ready, simulated)
    simulated.modifiers["Cloth"].show_viewport = True
    wanted = vertices(ready, simulated)
    ready.context.scene.frame_set(5)
    assert np.linalg.norm(wanted - plain, axis=-1).max() > 0.02
    assert ready.ops.ssilk.to_bones() == {"FINISHED"}
    assert ready.context.scene.frame_current == 5
    cloth, surface = simulated.modifiers["Cloth"], simulated.modifiers["Smooth"]
    assert not cloth.show_viewport and not cloth.show_render and surface.show_viewport
    away = np.linalg.norm(vertices(ready, simulated) - wanted, axis=-1)
    assert np.sqrt((away**2).mean()) <= 1.01e-3 and away.max() <= 5.05e-3
    assert any(key.name.startswith("SSILK ") for key in simulated.data.shape_keys.key_blocks)
    bones = ready.data.objects["Rig"].pose.bones
    assert max(bone.location.length for bone in bones if "proxy" in bone.name.lower()) > 1e-4  # proxies move, too


def test_a_proxy_that_cannot_move_by_itself_is_named(ready, simulated):
    bake_cloth(ready, simulated)
    proxy = next(bone for bone in ready.data.objects["Rig"].data.bones if "proxy" in bone.name.lower())
    proxy.use_local_location, keys = False, simulated.data.shape_keys
    with pytest.raises(RuntimeError, match=f"'{proxy.name}' cannot move by itself"):
        ready.ops.ssilk.to_bones()
    assert simulated.data.shape_keys == keys


def test_what_is_not_simulated_or_not_baked_is_refused(ready, simulated):
    with pytest.raises(RuntimeError, match="'Cloth' of 'Skirt' is not baked"):
        ready.ops.ssilk.to_bones()
    simulated.modifiers.remove(simulated.modifiers["Cloth"])
    with pytest.raises(RuntimeError, match="No modifier simulates 'Skirt'"):
        ready.ops.ssilk.to_bones()


@pytest.mark.parametrize("add, name", [(add_mdd, "cloth.mdd"), (add_alembic, "cloth.abc")])
def test_caches_become_bones(ready, walking, tmp_path, add, name):
    cache = add(ready, walking, tmp_path / name)
    turned_within_tolerance(ready, walking, cache, shown(ready, walking, FRAMES))


def test_cloth_dynamics_becomes_bones_whether_it_was_played_or_not(ready, walking):
    cloth = add_cloth_dynamics(ready, walking)
    wanted = shown(ready, walking, FRAMES)
    assert ready.ops.object.simulation_nodes_cache_delete(selected=True) == {"FINISHED"}
    turned_within_tolerance(ready, walking, cloth, wanted)


def test_a_cache_that_moves_nothing_is_refused(ready, walking, tmp_path):
    cache = add_mdd(ready, walking, tmp_path / "other.mdd", vertex_count=20)  # Blender passes over it
    for path in (cache.filepath, str(tmp_path / "gone.mdd")):
        cache.filepath = path
        with pytest.raises(RuntimeError, match="'Cached' moves no vertex of 'Skirt' in the frames 1, 7, 12"):
            ready.ops.ssilk.to_bones()


def test_a_cache_above_the_bones_is_told_to_go_below(ready, walking, tmp_path):
    add_mdd(ready, walking, tmp_path / "cloth.mdd")
    walking.modifiers.move(1, 0)
    with pytest.raises(RuntimeError, match="move it below the Armature modifier"):
        ready.ops.ssilk.to_bones()


def test_the_frame_is_left_alone_while_nodes_simulate(ready, walking, monkeypatch):
    from blender_addon.errors import SetupError
    from blender_addon.motions import simulated

    add_cloth_dynamics(ready, walking)
    ready.context.scene.frame_set(5)
    monkeypatch.setattr(simulated, "SLICE", 0.0)
    sampling = simulated.sample_vertices(walking, FRAMES, [])
    next(sampling)
    ready.context.scene.frame_set(9)
    with pytest.raises(SetupError, match="The frame was changed while 'Skirt' was simulated"):
        next(sampling)
    assert ready.context.scene.frame_current == 5
