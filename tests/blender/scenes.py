# SPDX-License-Identifier: Apache-2.0
"""A rigged skirt that moves, trained for a moment: what training, baking and the artist's session begin with."""

from __future__ import annotations

import json
import math
import subprocess
import time
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from .conftest import BONES, activate

LIVELY = """
import sys
from dataclasses import replace
import numpy as np
from ssilk_core.network.checkpoint import load_model, save_model
file, rng = load_model(sys.argv[1]), np.random.default_rng(3)
parameters = dict(file.parameters)
parameters["output.4.weight"] = parameters["output.4.weight"] * 300
parameters["decoder.shapes"] = parameters["decoder.shapes"] * 20
parameters["decoder.skin_offset"] = rng.normal(0, 0.5, parameters["decoder.skin_offset"].shape).astype(np.float32)
save_model(sys.argv[1], replace(file, parameters=parameters))
"""
DECODED = """
import sys
import numpy as np
from ssilk_core.delivery.bake import BakeRequest, load_rollout
model, stage, motion, seconds, lbs, output = sys.argv[1:]
request = BakeRequest(model=model, stage=stage, motion=motion, pre_roll=float(seconds), lbs=lbs == "lbs")
bake = load_rollout(request)
np.save(output, [bake.units.points_from_core(points) for points in bake.vertices()])
"""


def animate(bpy: ModuleType, armature: Any, name: str, size: float, frames: int, *, first: int = 1) -> Any:
    """Give an armature an action in which it sways, turns and jumps; return the action."""
    action = bpy.data.actions.new(name)
    action.use_fake_user = True  # or a file would not keep it while another one plays
    armature.animation_data_create().action = action
    hips, spine = (armature.pose.bones[bone] for bone in ("Hips", "Spine"))
    hips.rotation_mode = spine.rotation_mode = "QUATERNION"
    for frame in range(first, first + frames, 4):
        turn, pace = 2 * math.pi * frame / 40, frame / 5
        hips.location = (size * math.sin(pace), size * 0.3 * math.cos(pace), 0.1 * frame / 10)
        hips.rotation_quaternion = (math.cos(turn * size), 0.1 * math.sin(pace), math.sin(turn * size), 0.05)
        spine.rotation_quaternion = (1, 0.2 * math.sin(pace), 0, 0.2 * size)
        for bone, path in ((hips, "location"), (hips, "rotation_quaternion"), (spine, "rotation_quaternion")):
            bone.keyframe_insert(path, frame=frame)
    return action


def rig_and_animate(bpy: ModuleType, garment: Any, frames: int = 40) -> None:
    """Classify a skirt, rig it with six proxies, and animate its armature twice."""
    activate(bpy, garment)
    assert bpy.ops.ssilk.classify() == {"FINISHED"}
    assert bpy.ops.ssilk.generate_rig(proxies=6) == {"FINISHED"}
    armature = bpy.data.objects["Rig"]
    animate(bpy, armature, "Spin Ö", 0.6, frames)
    animate(bpy, armature, "Walk", 0.3, frames)
    bpy.context.scene.frame_start, bpy.context.scene.frame_end = 1, frames


def ended(garment: Any, *, after: int = 0, until: Any = None, seconds: float = 120) -> Any:
    """Wait until the training of a garment has come so far, is as asked, or has ended; return its state."""
    from blender_addon.outside.jobs import read_state
    from blender_addon.playback.models import job_of

    deadline = time.monotonic() + seconds
    until = until or (lambda state: after and state.done >= after)
    while (state := read_state(job_of(garment))).alive and not until(state):
        assert time.monotonic() < deadline, state
        time.sleep(0.05)
    return state


def enliven(python: str, model: Path) -> None:
    """Make a model that was trained for a moment move its proxies and shapes visibly."""
    subprocess.run([python, "-c", LIVELY, str(model)], check=True)


def decoded(python: str, model: Path, folder: Path, *, pre_roll: float = 0.0, lbs: bool = False) -> np.ndarray:
    """Return the decoder's own vertices of the last bake in Blender's world, shape (F, V, 3)."""
    inputs, output = model.parent / "bake", folder / "decoded.npy"
    words = [model, model.parent / "dressed.usdc", inputs / "motion.usdc", pre_roll, "lbs" if lbs else "", output]
    subprocess.run([python, "-c", DECODED, *map(str, words)], check=True)
    return np.load(output)


def shown(bpy: ModuleType, garment: Any, frames: range) -> np.ndarray:
    """Return the vertices that Blender's dependency graph evaluates, in world space, shape (F, V, 3)."""
    found = []
    for frame in frames:
        bpy.context.scene.frame_set(frame)
        evaluated = garment.evaluated_get(bpy.context.evaluated_depsgraph_get())
        mesh = evaluated.to_mesh()
        points = np.empty(len(mesh.vertices) * 3, dtype=np.float32)
        mesh.vertices.foreach_get("co", points)
        evaluated.to_mesh_clear()
        world = np.array(evaluated.matrix_world)
        found.append(points.reshape(-1, 3) @ world[:3, :3].T + world[:3, 3])
    return np.array(found)


def state_file(garment: Any) -> dict[str, Any]:
    """Return what stands in a job's small file."""
    from blender_addon.playback.models import job_of

    return json.loads((job_of(garment) / "state.json").read_text())


def train_skirt(bpy: ModuleType, skirt: Any, path: Path, python: str) -> None:
    """Train the skirt for a moment on its pillar, make its model lively, and save the file."""
    from blender_addon.playback.models import model_of

    rig_and_animate(bpy, skirt)
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    assert bpy.ops.ssilk.find_motions() == {"FINISHED"}
    skirt.ssilk.training.preset, skirt.ssilk.training.iterations = "draft", 4
    assert bpy.ops.ssilk.train() == {"FINISHED"}
    assert ended(skirt).state == "done"
    enliven(python, model_of(skirt))
    bpy.ops.wm.save_mainfile()


def weights_of(thing: Any) -> np.ndarray:
    """Return the weights of a mesh in all of its vertex groups, shape (V, groups)."""
    matrix = np.zeros((len(thing.data.vertices), len(thing.vertex_groups)))
    for vertex in thing.data.vertices:
        for element in vertex.groups:
            matrix[vertex.index, element.group] = element.weight
    return matrix


def proxies_of(bpy: ModuleType) -> list[str]:
    return [bone.name for bone in bpy.data.objects["Rig"].data.bones if bone.name not in BONES]
