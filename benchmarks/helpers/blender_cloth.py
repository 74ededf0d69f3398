# SPDX-License-Identifier: Apache-2.0
"""Blender's cloth modifier on a garment over a moving body, timed frame by frame. Run by `runtime.py` under bpy.

    python blender_cloth.py SHOT.npz TIMES.json

The body's vertices and the garment's pinned ones follow a point cache, with and without the Cloth modifier; what
the modifier takes is the difference. Settings are Blender's own defaults, those of a new Cloth modifier.
"""

from __future__ import annotations

import json
import struct
import sys
import time
from pathlib import Path

import bpy
import numpy as np


def write_cache(path: Path, points: np.ndarray) -> str:
    """Write points (F, V, 3) as a PC2 point cache; return its path."""
    header = struct.pack("<12siiffi", b"POINTCACHE2\0", 1, points.shape[1], 1.0, 1.0, len(points))
    path.write_bytes(header + points.astype("<f4").tobytes())
    return str(path)


def add_mesh(name: str, points: np.ndarray, faces: np.ndarray, folder: Path) -> bpy.types.Object:
    """Add a mesh that follows a point cache of points (F, V, 3)."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(points[0].tolist(), [], faces.tolist())
    thing = bpy.data.objects.new(name, mesh)
    bpy.context.collection.objects.link(thing)
    cache = thing.modifiers.new("Cache", "MESH_CACHE")
    cache.cache_format, cache.filepath = "PC2", write_cache(folder / f"{name}.pc2", points)
    return thing


def played(frames: int) -> list[float]:
    """Play the scene once; return the processor time of each frame [s]."""
    taken = []
    for frame in range(1, frames + 1):
        start = time.process_time()
        bpy.context.scene.frame_set(frame)
        taken.append(time.process_time() - start)
    return taken


def main(source: Path, result: Path) -> None:
    shot = np.load(source)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end, scene.render.fps = 1, len(shot["garment"]), int(shot["fps"])
    add_mesh("Body", shot["body"], shot["body_faces"], source.parent).modifiers.new("Collision", "COLLISION")
    garment = add_mesh("Garment", shot["garment"], shot["garment_faces"], source.parent)
    garment.vertex_groups.new(name="Pinned").add(shot["pinned"].tolist(), 1.0, "REPLACE")
    without = played(scene.frame_end)
    cloth = garment.modifiers.new("Cloth", "CLOTH")
    cloth.settings.vertex_group_mass = "Pinned"
    cloth.point_cache.frame_end = scene.frame_end
    whole = played(scene.frame_end)
    moved = np.empty(len(garment.data.vertices) * 3, dtype=np.float32)
    garment.evaluated_get(bpy.context.evaluated_depsgraph_get()).data.vertices.foreach_get("co", moved)
    away = float(np.abs(moved.reshape(-1, 3) - shot["garment"][-1]).max())
    result.write_text(
        json.dumps({"without": without, "with": whole, "moved": away, "blender": bpy.app.version_string})
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
