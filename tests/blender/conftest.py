# SPDX-License-Identifier: Apache-2.0
"""A pillar with three bones in a flared skirt, in Blender, and the Python that ssilk is installed in.

What needs Blender is skipped without the bpy module, and what needs ssilk without a Python that has it:
SSILK_PYTHON, else this one, else .venv of the repository.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "usd"))  # as the wheel in the zip brings it
HEIGHTS = (0.8, 1.2, 1.5)  # of the bones [m]
BONES = ("Hips", "Spine", "Head")


@pytest.fixture(scope="session")
def ssilk_python() -> str:
    """The path of a Python that has ssilk installed, with what `ssilk rig` needs."""
    here = [sys.executable] if importlib.util.find_spec("torch") else []
    candidates = [os.environ.get("SSILK_PYTHON", ""), *here, str(ROOT / ".venv" / "bin" / "python")]
    found = next((path for path in candidates if path and Path(path).exists()), None)
    if found is None:
        pytest.skip("no Python with ssilk: set SSILK_PYTHON, or run `make test` once")
    return found


@pytest.fixture
def bpy() -> Iterator[ModuleType]:
    """The bpy module with an empty scene and the extension enabled, as a plain add-on from its folder."""
    bpy = pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")
    import addon_utils

    bpy.ops.wm.read_factory_settings(use_empty=True)
    assert addon_utils.enable("blender_addon", default_set=True)
    yield bpy
    addon_utils.disable("blender_addon", default_set=True)


@pytest.fixture(autouse=True)
def own_queue(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> None:
    """Let trainings line up apart from those of whoever works on this machine."""
    from blender_addon.outside import jobs

    folder = tmp_path_factory.getbasetemp() / "queue"
    monkeypatch.setattr(jobs, "queue_folder", lambda: folder)


@pytest.fixture(scope="session")
def met() -> dict[str, str]:
    """What the Python with ssilk said of itself: asking takes seconds, once is enough."""
    return {}


@pytest.fixture
def ready(bpy: ModuleType, ssilk_python: str, met: dict[str, str]) -> ModuleType:
    """Blender with a Python that was chosen and checked."""
    preferences = bpy.context.preferences.addons["blender_addon"].preferences
    preferences.python = ssilk_python
    if not met:
        assert bpy.ops.ssilk.check_python() == {"FINISHED"}
        met["handshake"] = preferences.handshake
    preferences.handshake = met["handshake"]
    return bpy


@pytest.fixture
def skirt(bpy: ModuleType) -> Any:
    """A skirt without weights, active and selected, and a pillar bound to an armature of three bones."""
    armature = add_armature(bpy)
    pillar = add_mesh(bpy, "Pillar", *tube(16, 18, (0.0, 1.7), (0.15, 0.15)))
    for name, low, high in zip(BONES, (0.0, *HEIGHTS[1:]), (*HEIGHTS[1:], 9.0)):
        inside = [vertex.index for vertex in pillar.data.vertices if low <= vertex.co.z < high]
        pillar.vertex_groups.new(name=name).add(inside, 1.0, "REPLACE")
    pillar.modifiers.new("Armature", "ARMATURE").object = armature
    garment = add_mesh(bpy, "Skirt", *tube(24, 13, (0.6, 1.0, 1.3), (0.5, 0.165, 0.165)))
    activate(bpy, garment)
    return garment


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder whose name is not easy, for what several tests of a module open; it fills as they ask for it."""
    return tmp_path_factory.mktemp("scenes of größe")


@pytest.fixture
def classified(ready: ModuleType, skirt: Any, folder: Path) -> Any:
    """The skirt with automatic classes."""
    if not opened(ready, folder / "classified.blend"):
        assert ready.ops.ssilk.classify() == {"FINISHED"}
        ready.ops.wm.save_as_mainfile(filepath=str(folder / "classified.blend"))
    return ready.data.objects["Skirt"]


@pytest.fixture
def rigged(ready: ModuleType, classified: Any, folder: Path) -> Any:
    """The skirt, classified and rigged with six proxies."""
    if not opened(ready, folder / "rigged.blend"):
        assert ready.ops.ssilk.generate_rig(proxies=6) == {"FINISHED"}
        ready.ops.wm.save_as_mainfile(filepath=str(folder / "rigged.blend"))
    return ready.data.objects["Skirt"]


@pytest.fixture
def trained(ready: ModuleType, skirt: Any, folder: Path, ssilk_python: str) -> Any:
    """The skirt on an animated pillar, active, with a model that moves it visibly."""
    from .scenes import train_skirt

    if not opened(ready, folder / "trained.blend"):
        train_skirt(ready, skirt, folder / "trained.blend", ssilk_python)
    activate(ready, ready.data.objects["Skirt"])
    return ready.data.objects["Skirt"]


def opened(bpy: ModuleType, path: Path) -> bool:
    """Open a file if it is there; return whether it is."""
    if path.exists():
        bpy.ops.wm.open_mainfile(filepath=str(path))
    return path.exists()


def add_armature(bpy: ModuleType) -> Any:
    armature = bpy.data.objects.new("Rig", bpy.data.armatures.new("Rig"))
    bpy.context.collection.objects.link(armature)
    activate(bpy, armature)
    bpy.ops.object.mode_set(mode="EDIT")
    above = None
    for name, height in zip(BONES, HEIGHTS):
        bone = armature.data.edit_bones.new(name)
        bone.head, bone.tail, bone.parent = (0, 0, height), (0, 0, height + 0.2), above
        above = bone
    bpy.ops.object.mode_set(mode="OBJECT")
    return armature


def add_mesh(bpy: ModuleType, name: str, points: np.ndarray, faces: np.ndarray) -> Any:
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(points.tolist(), [], faces.tolist())
    thing = bpy.data.objects.new(name, mesh)
    bpy.context.collection.objects.link(thing)
    return thing


def activate(bpy: ModuleType, thing: Any) -> None:
    """Make an object the only selected one, and the active one."""
    for other in bpy.context.scene.objects:
        other.select_set(False)
    thing.select_set(True)
    bpy.context.view_layer.objects.active = thing


def make_meta(bpy: ModuleType, owner: Any, animation: Any) -> None:
    """Join all strips of an object or of its shape keys into a meta strip, as Shift G does in the NLA editor."""
    activate(bpy, owner)
    for track in animation.nla_tracks:
        track.select = True
        for strip in track.strips:
            strip.select = True
    window = bpy.context.window_manager.windows[0]
    area = window.screen.areas[0]
    before, area.ui_type = area.ui_type, "NLA_EDITOR"
    with bpy.context.temp_override(window=window, area=area, region=area.regions[-1]):
        assert bpy.ops.nla.meta_add() == {"FINISHED"}
    area.ui_type = before
    assert [strip.type for track in animation.nla_tracks for strip in track.strips] == ["META"]


def tube(columns: int, rows: int, heights: tuple[float, ...], radii: tuple[float, ...]) -> tuple[Any, Any]:
    """Quads around the z axis, normals outward, with radii interpolated between heights [m]."""
    angle, z = np.arange(columns) * 2 * np.pi / columns, np.linspace(heights[0], heights[-1], rows)
    radius = np.interp(z, heights, radii)[:, None]
    points = np.stack(np.broadcast_arrays(radius * np.cos(angle), radius * np.sin(angle), z[:, None]), -1)
    row, column = (part.reshape(-1) for part in np.mgrid[0 : rows - 1, 0:columns])
    a, b = row * columns + column, row * columns + (column + 1) % columns
    return points.reshape(-1, 3), np.c_[a, b, b + columns, a + columns]
