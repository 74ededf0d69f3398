# SPDX-License-Identifier: Apache-2.0
"""An artist's session without a window, on the demo's body and cape: from files to a baked timeline, and again."""

from __future__ import annotations

import math
import subprocess
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

pytest.importorskip("bpy", reason="the bpy module is not installed: `make test-blender`")

from .conftest import ROOT, activate
from .scenes import decoded, ended, shown

BODY = ROOT / "usd" / "ssilk_usd" / "stages" / "demo_body.usdc"
FRAMES = range(1, 25)
WARDROBE = """
import sys
from pathlib import Path
from ssilk_usd.reading.character import read_character
from ssilk_usd.writing.files import write_garment, write_motion
from ssilk_core.demo.garments import build_garment
from ssilk_core.demo.motions import training_motions
body, out = Path(sys.argv[1]), Path(sys.argv[2])
character = read_character(body)
write_garment(out / "cape.usdc", build_garment("cape", character).mesh)
motion = training_motions(character.skeleton)[0]
write_motion(out / "walk ä.usdc", motion.clip(0, 60), character.skeleton)
"""


@pytest.fixture
def wardrobe(ssilk_python, tmp_path) -> Path:
    """A folder with the demo's cape and a motion of its body."""
    folder = tmp_path / "Schöne Kleider"
    folder.mkdir()
    subprocess.run([ssilk_python, "-c", WARDROBE, str(BODY), str(folder)], check=True)
    return folder


def imported(bpy: ModuleType, path: Path) -> Any:
    """Import a file; return the first mesh that it brings."""
    before = set(bpy.data.objects)
    bpy.ops.wm.usd_import(filepath=str(path))
    return next(thing for thing in bpy.data.objects if thing not in before and thing.type == "MESH")


def animate(armature: Any) -> None:
    """Let the character sway and turn."""
    for frame in range(FRAMES.start, FRAMES.stop, 3):
        for number, bone in enumerate(armature.pose.bones):
            if len(bone.parent_recursive) > 3 or "proxy" in bone.name:
                continue
            angle = 0.15 * math.sin(frame / 4 + number)
            bone.rotation_mode = "QUATERNION"
            bone.rotation_quaternion = (1.0, angle, 0.5 * angle, 0.3 * angle)
            bone.keyframe_insert("rotation_quaternion", frame=frame)


def fill(bpy: ModuleType, garment: Any, chosen: np.ndarray, value: str) -> None:
    """Give vertices a class in edit mode, as an artist does."""
    activate(bpy, garment)
    garment.data.vertices.foreach_set("select", chosen)
    garment.data.edges.foreach_set("select", np.zeros(len(garment.data.edges), dtype=bool))
    garment.data.polygons.foreach_set("select", np.zeros(len(garment.data.polygons), dtype=bool))
    bpy.ops.object.mode_set(mode="EDIT")
    bpy.context.tool_settings.mesh_select_mode = (True, False, False)
    assert bpy.ops.ssilk.fill_class(value=value) == {"FINISHED"}
    bpy.ops.object.mode_set(mode="OBJECT")


def heights(garment: Any) -> np.ndarray:
    points = np.empty(len(garment.data.vertices) * 3, dtype=np.float32)
    garment.data.vertices.foreach_get("co", points)
    world = np.array(garment.matrix_world)
    return (points.reshape(-1, 3) @ world[:3, :3].T + world[:3, 3])[:, 2]


def move_and_cut(bpy: ModuleType, armature: Any, names: list[str]) -> None:
    """Move one proxy and delete the end of a chain."""
    activate(bpy, armature)
    bpy.ops.object.mode_set(mode="EDIT")
    bones = armature.data.edit_bones
    bones[names[0]].translate(bones[names[0]].vector * 0.3)
    bones.remove(bones[next(name for name in reversed(names) if not bones[name].children)])
    bpy.ops.object.mode_set(mode="OBJECT")


def train(bpy: ModuleType, garment: Any) -> Path:
    """Train for a moment; return the model."""
    from blender_addon.playback.models import model_of

    activate(bpy, garment)
    assert bpy.ops.ssilk.train() == {"FINISHED"}
    state = ended(garment, seconds=600)  # it validates on the CPU, which others may use
    assert state.state == "done", state
    return model_of(garment)


def test_from_files_to_a_timeline_and_again(ready, wardrobe, ssilk_python, tmp_path):
    from blender_addon.rigging.proxies import proxy_names
    from blender_addon.scene.classes import read_classes

    bpy, scene = ready, ready.context.scene
    imported(bpy, BODY)
    garment = imported(bpy, wardrobe / "cape.usdc")
    armature = next(thing for thing in bpy.data.objects if thing.type == "ARMATURE")
    activate(bpy, garment)
    assert bpy.ops.ssilk.classify() == {"FINISHED"}
    top = heights(garment) > np.quantile(heights(garment), 0.9)
    fill(bpy, garment, top, "PINNED")
    assert (read_classes(garment.data)[top] == 0).all()
    assert bpy.ops.ssilk.generate_rig(proxies=8) == {"FINISHED"}
    count = len(proxy_names(armature, garment))
    move_and_cut(bpy, armature, proxy_names(armature, garment))
    assert len(proxy_names(armature, garment)) == count - 1
    activate(bpy, garment)
    assert bpy.ops.ssilk.generate_rig(proxies=8) == {"FINISHED"}
    assert len(proxy_names(armature, garment)) == count - 1

    animate(armature)
    scene.frame_start, scene.frame_end = FRAMES.start, FRAMES.stop - 1
    bpy.ops.wm.save_as_mainfile(filepath=str(wardrobe / "Szene 1.blend"))
    activate(bpy, garment)
    assert bpy.ops.ssilk.find_motions() == {"FINISHED"}
    bpy.ops.ssilk.add_motion_files(directory=str(wardrobe), files=[{"name": "walk ä.usdc"}])
    garment.ssilk.training.preset, garment.ssilk.training.iterations = "draft", 4
    model = train(bpy, garment)
    assert bpy.ops.ssilk.bake() == {"FINISHED"}
    first = decoded(ssilk_python, model, tmp_path, pre_roll=1.0)
    assert np.abs(shown(bpy, garment, FRAMES) - first).max() < 1e-5

    names = garment.name, armature.name
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    garment, armature = (bpy.data.objects[name] for name in names)
    backwards = shown(bpy, garment, FRAMES[::-1])
    assert np.abs(backwards[::-1] - first).max() < 1e-5

    lower = (heights(garment) > np.quantile(heights(garment), 0.8)) & ~top
    fill(bpy, garment, lower, "TIGHT")
    activate(bpy, garment)
    assert bpy.ops.ssilk.generate_rig(proxies=8) == {"FINISHED"}
    again = train(bpy, garment)
    assert again != model
    assert bpy.ops.ssilk.bake() == {"FINISHED"}
    second = decoded(ssilk_python, again, tmp_path, pre_roll=1.0)
    assert np.abs(shown(bpy, garment, FRAMES) - second).max() < 1e-5
    assert len(armature.animation_data.nla_tracks) == 1
