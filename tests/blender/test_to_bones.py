# SPDX-License-Identifier: Apache-2.0
"""To Bones: what a simulation in Blender showed is what bones and shape keys show, without the simulation."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from .conftest import activate
from .scenes import animate, shown

FRAMES = range(1, 13)


@pytest.fixture
def simulated(ready, rigged):
    """The rigged skirt on a moving pillar with a baked Cloth modifier and a surface that is refined."""
    bpy = ready
    animate(bpy, bpy.data.objects["Rig"], "Walk", 0.3, FRAMES.stop)
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = FRAMES.start, FRAMES.stop - 1
    cloth = rigged.modifiers.new("Cloth", "CLOTH")
    pins = rigged.vertex_groups.new(name="Pins")
    pins.add([v.index for v in rigged.data.vertices if v.co.z > 1.0], 1.0, "REPLACE")
    cloth.settings.vertex_group_mass, cloth.settings.quality = "Pins", 3
    cloth.point_cache.frame_start, cloth.point_cache.frame_end = FRAMES.start, FRAMES.stop - 1
    rigged.modifiers.new("Smooth", "SUBSURF").show_viewport = True
    activate(bpy, rigged)
    return rigged


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
