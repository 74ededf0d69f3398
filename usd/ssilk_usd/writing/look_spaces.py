# SPDX-License-Identifier: Apache-2.0
"""Spaces that a look is said in: places and directions of a mesh's own space, and colour spaces of what is above.

A mesh is written in another space than its source has it, as where units differ.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom

from ssilk_core.scene.assets import Floats

SAME = 1e-4  # of the size of a mesh: points that are nearer are equal, as float32 has them
ROLES = ("Point", "Vector", "Normal")
WRITTEN = ("points", "normals", "velocities", "accelerations")  # by others
_VECTORS = (Gf.Vec3f, Gf.Vec3d, Gf.Vec3h)


def move_spaces(layer: Sdf.Layer, source: Usd.Prim, written: Usd.Prim, first: Usd.TimeCode) -> list[str]:
    """Bring a copy's attributes of USD's roles point, vector and normal into the space of the written mesh.

    Args:
        layer: which holds the copy.
        source: the mesh that was copied.
        written: the copy, whose points are written already.
        first: when the points of the source are read.

    Returns:
        Names of attributes that stay as they were, since the mesh has another shape now.
    """
    paths = [
        spec.path
        for spec in layer.GetPrimAtPath(written.GetPath()).attributes
        if spec.roleName in ROLES and spec.default is not None and source.HasAttribute(spec.name)
        and spec.name not in WRITTEN
    ]  # fmt: skip
    if not paths:
        return []
    before, after = (np.array(UsdGeom.Mesh(prim).GetPointsAttr().Get(first)) for prim in (source, written))
    moved = similarity(before.astype(np.float64), after.astype(np.float64))
    if moved is None:
        return [path.name for path in paths]
    if np.allclose(moved, np.eye(4), atol=SAME):
        return []
    for path in paths:
        spec = layer.GetAttributeAtPath(path)
        spec.default = _moved(spec.default, spec.roleName, moved)
    return []


def similarity(before: Floats, after: Floats) -> Floats | None:
    """Return what turns, mirrors, scales evenly and moves points onto others, shape (4, 4); None where nothing does.

    Umeyama (1991), least squares. Points of a plane are turned, and never mirrored.

    Args:
        before, after: shape (V, 3) each.
    """
    if len(before) != len(after) or not len(before):
        return None
    middles = before.mean(axis=0), after.mean(axis=0)
    centred = before - middles[0], after - middles[1]
    left, sizes, right = np.linalg.svd(centred[1].T @ centred[0])
    turn = left @ right
    if sizes[2] <= SAME * sizes[0] and np.linalg.det(turn) < 0:
        sizes[2], turn = -sizes[2], left @ np.diag([1.0, 1.0, -1.0]) @ right
    spread = (centred[0] ** 2).sum()
    found = np.eye(4)
    found[:3, :3] = turn * (sizes.sum() / spread if spread > 0 else 1.0)
    found[:3, 3] = middles[1] - found[:3, :3] @ middles[0]
    off = np.abs(before @ found[:3, :3].T + found[:3, 3] - after).max()
    return found if off <= SAME * np.ptp(after, axis=0).max() else None


def _moved(default: Any, role: str, by: Floats) -> Any:
    linear, shift = by[:3, :3], by[:3, 3] if role == "Point" else 0.0
    if role == "Normal":
        linear = linear / np.cbrt(abs(np.linalg.det(linear)))
    values = np.array(default, dtype=np.float64).reshape(-1, 3) @ linear.T + shift
    if isinstance(default, _VECTORS):
        return type(default)(*values[0].tolist())
    return type(default).FromNumpy(values.astype(np.array(default).dtype))


def keep_colour_space(source: Usd.Prim, written: Usd.Prim) -> None:
    """Let colours and textures of a copy be read in the colour space that the source has from above it."""
    api = getattr(Usd, "ColorSpaceAPI", None)  # since USD 25.05
    if api is None:
        return
    wanted = api.ComputeColorSpaceName(source, None)
    if wanted and wanted != api.ComputeColorSpaceName(written, None):
        api.Apply(written).CreateColorSpaceNameAttr(wanted)
