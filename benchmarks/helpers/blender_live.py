# SPDX-License-Identifier: Apache-2.0
"""Live playback of a trained garment in Blender, timed frame by frame. Run by `runtime.py` under bpy.

    python blender_live.py MODEL TIMES.json

Armature and garment are built from the model itself; every bone turns. What is timed is the extension's own part:
reading the armature's pose, rolling and decoding, writing bones and shape keys. Blender's evaluation is not.
"""

from __future__ import annotations

import importlib
import json
import sys
import time
from pathlib import Path

import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))
sys.path.insert(0, str(Path(__file__).parents[2] / "usd"))

from mathutils import Matrix
from ssilk_usd.units import StageUnits

from ssilk_core.network.checkpoint import load_model
from ssilk_core.scene.assets import Scene

FRAMES = 300
UNITS = StageUnits(1.0, "Z")  # of Blender's empty scene


def build(path: Path) -> bpy.types.Object:
    """Make the garment of a model on its armature; return it, active."""
    scene = load_model(path).scene
    mesh, points = bpy.data.meshes.new("Garment"), UNITS.points_from_core(scene.garment.mesh.points)
    mesh.from_pydata(points.tolist(), [], scene.garment.mesh.faces.tolist())
    garment = bpy.data.objects.new("Garment", mesh)
    armature = bpy.data.objects.new("Rig", bpy.data.armatures.new("Rig"))
    body = bpy.data.objects.new("Body", bpy.data.meshes.new("Body"))  # a model has none, and playing needs one
    body.data.from_pydata([(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0)], [], [(0, 1, 2)])
    for thing in (armature, garment, body):
        bpy.context.collection.objects.link(thing)
    for thing in (garment, body):
        thing.modifiers.new("Armature", "ARMATURE").object = armature
    add_bones(armature, garment, scene)
    body.vertex_groups.new(name=armature.data.bones[0].name).add([0, 1, 2], 1.0, "REPLACE")
    bpy.context.view_layer.objects.active = garment
    return garment


def add_bones(armature: bpy.types.Object, garment: bpy.types.Object, scene: Scene) -> None:
    """Make a bone of each joint, the proxies marked as the garment's."""
    from blender_addon.scene.armature import made_collection

    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    bones: list[bpy.types.EditBone] = []
    for path, parent, bind in zip(
        scene.joint_names, scene.parents, UNITS.transforms_from_core(scene.bind_transforms)
    ):
        bone = armature.data.edit_bones.new(path.rpartition("/")[2])
        bone.tail, bone.parent = (0.0, 0.1, 0.0), bones[parent] if parent >= 0 else None
        bone.matrix = Matrix(bind)
        bones.append(bone)
    for bone in bones[len(bones) - scene.rig.proxy_count :]:
        made_collection(armature.data, garment).assign(bone)
    bpy.ops.object.mode_set(mode="OBJECT")


def animate(armature: bpy.types.Object, frames: int) -> None:
    """Turn every bone of the character."""
    random = np.random.default_rng(0)
    for bone in armature.pose.bones:
        bone.rotation_mode = "QUATERNION"
        for frame in range(1, frames + 10, 10):
            bone.rotation_quaternion = (1.0, *random.normal(0, 0.05, 3))
            bone.keyframe_insert("rotation_quaternion", frame=frame)


def main(model: Path, result: Path) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    importlib.import_module("addon_utils").enable("blender_addon", default_set=True)
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end, scene.render.fps = 1, FRAMES, 30
    garment = build(model)
    animate(bpy.data.objects["Rig"], FRAMES)
    garment.ssilk.model = str(model.absolute())
    from blender_addon.playback import playing

    assert bpy.ops.ssilk.play_live() == {"FINISHED"}
    played, taken = playing.live(garment), []
    assert played is not None
    playing.stop_listening()
    for frame in range(1, FRAMES + 1):
        scene.frame_set(frame)
        depsgraph = bpy.context.evaluated_depsgraph_get()
        start = time.process_time()
        played.show(scene, depsgraph)
        taken.append(time.process_time() - start)
    result.write_text(json.dumps({"show": taken}))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
