# SPDX-License-Identifier: Apache-2.0
"""The meshes of a shot at rest, and what its garments say of themselves."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pxr import Usd, UsdGeom

from ssilk_core.assets import Mesh

from .garment_api import GarmentRecord, read_garment_record
from .play import Shot
from .read_mesh import read_mesh
from .read_stage import apply


@dataclass(frozen=True, eq=False)
class ShotPart:
    """A mesh of a shot at rest [m], and how its model was made; None for bodies and for what does not say."""

    mesh: Mesh
    record: GarmentRecord | None


def read_parts(shot: Shot) -> list[ShotPart]:
    """Return the meshes of a shot at rest, in their order: points without a time, or the earliest ones."""
    return [_part(shot, shot.stage.GetPrimAtPath(mesh.path)) for mesh in shot.meshes]


def _part(shot: Shot, prim: Usd.Prim) -> ShotPart:
    mesh = read_mesh(prim, shot.units.matrix)
    timeless = np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get(Usd.TimeCode.Default()) or [], dtype=np.float64)
    if len(timeless) == mesh.vertex_count:
        mesh = replace(mesh, points=apply(shot.units.matrix, timeless))
    return ShotPart(mesh, read_garment_record(prim))
