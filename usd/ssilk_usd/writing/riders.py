# SPDX-License-Identifier: Apache-2.0
"""Write what rides on a garment over a character's stage, as `reading.riders` reads it."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from pxr import Sdf, Vt

from ssilk_core.files import replacing
from ssilk_core.scene.assets import Mesh

from ..names import RIDE_VERTICES, RIDES_ON
from ..opening.stage import open_stage
from ..reading.skeleton import find_skeleton
from ..units import StageUnits
from .author import define_mesh, free_name
from .export import new_stage, save


def write_riders(path: str | Path, stage: str | Path, garment: str, riders: Mapping[Mesh, tuple[int, ...]]) -> None:
    """Write a stage over a character's, which stays as it is, with rigid things on its garment.

    Args:
        path: the file to write.
        stage: the character's file; its bind pose is its world, as `write_scene` writes it.
        garment: path of the garment's mesh.
        riders: meshes at the bind pose [m], whose paths name their prims, with the three vertices of the garment that
            carry each.

    Raises:
        SsilkError: a file cannot be read or written.
    """
    below = open_stage(stage)
    units, root = StageUnits.of(below), find_skeleton(below).root
    taken = {child.GetName() for child in root.GetAllChildren()}
    with replacing(path) as temporary:
        over = new_stage(temporary, units)
        over.GetRootLayer().subLayerPaths.append(os.path.relpath(stage, Path(path).parent))
        over.GetRootLayer().defaultPrim = root.GetPath().name
        for mesh, vertices in riders.items():
            name = free_name(mesh.path.rpartition("/")[2], taken)
            taken.add(name)
            prim = define_mesh(over, root.GetPath().AppendChild(name), mesh, units).GetPrim()
            prim.CreateRelationship(RIDES_ON, False).SetTargets([garment])
            chosen = prim.CreateAttribute(RIDE_VERTICES, Sdf.ValueTypeNames.IntArray, False, Sdf.VariabilityUniform)
            chosen.Set(Vt.IntArray(vertices))
        save(over.GetRootLayer(), path)
        del over
