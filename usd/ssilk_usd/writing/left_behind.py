# SPDX-License-Identifier: Apache-2.0
"""What is drawn of a character, and is not written with it: hair curves, points, instances, meshes of no joint."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pxr import Usd, UsdGeom

from ssilk_core.files import split_body, split_location
from ssilk_core.scene.assets import Character, Mesh

from ..opening.stage import PRIMS, open_stage
from ..reading.mesh import is_body, is_drawn, is_stand_in

NAMED = 3  # of them are named at most


def left_behind(character: Character, written: Sequence[Mesh]) -> list[str]:
    """Return in words what a character's stage draws beneath its SkelRoot and nobody writes; garments are no loss.

    Args:
        written: the meshes that are.
    """
    file, path = split_location(character.path)
    if not Path(split_body(file)[0]).is_file():
        return []
    stage = open_stage(file)  # which lives for as long as it has a name
    root = stage.GetPrimAtPath(path or "/")
    if not root:
        return []
    known = {split_location(mesh.path)[1] for mesh in written}
    names: list[str] = []
    prims = iter(Usd.PrimRange(root, PRIMS))
    for prim in prims:
        if str(prim.GetPath()) in known or not (prim.IsA(UsdGeom.Gprim) or prim.IsA(UsdGeom.PointInstancer)):
            continue
        prims.PruneChildren()  # prototypes of instances
        worn = prim.IsA(UsdGeom.Mesh) and not is_body(prim)
        if is_drawn(prim) and not is_stand_in(prim) and not worn:
            names.append(f"the {prim.GetTypeName()} {prim.GetName()}")
    more = [f"{len(names) - NAMED} more"] if len(names) > NAMED else []
    return [*names[:NAMED], *more]
