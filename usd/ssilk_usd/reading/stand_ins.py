# SPDX-License-Identifier: Apache-2.0
"""Garments that were put onto a character with another skeleton, and which of its joints stand for their own."""

from __future__ import annotations

from dataclasses import dataclass

from pxr import Usd, UsdGeom

from ssilk_core.errors import fail
from ssilk_core.scene.assets import Garment, Skeleton

from ..names import FROM_JOINTS, ONTO_JOINTS
from ..opening.stage import PRIMS, StageLike, location, needs_whole_files, open_stage, value
from .garment import fitted_skeleton, read_garment


@dataclass(frozen=True, eq=False)
class PutOn:
    """A garment that was put onto another skeleton.

    Attributes:
        garment: where it lies there.
        stands_for: for each joint of the character that it was made on the one that stands for it, or "".
    """

    garment: Garment
    stands_for: dict[str, str]


@needs_whole_files
def read_put_on(source: StageLike, skeleton: Skeleton, prim: str) -> list[PutOn]:
    """Return the garments of a stage that were put onto a skeleton.

    Args:
        skeleton: of the character, as it was read from the same stage.
        prim: path of its Skeleton.

    Raises:
        SsilkError: what such a garment says is damaged, or the garment is.
    """
    stage, found = open_stage(source), []
    for mesh in Usd.PrimRange.Stage(stage, PRIMS):
        if not mesh.IsA(UsdGeom.Mesh) or value(mesh, FROM_JOINTS) is None:
            continue
        skel = fitted_skeleton(mesh, None)
        if skel is None or str(skel.prim.GetPath()) != prim:
            continue
        own, others = ([str(name) for name in value(mesh, key) or ()] for key in (FROM_JOINTS, ONTO_JOINTS))
        if len(own) != len(others):
            told = f"{len(own)} joints in {FROM_JOINTS} and {len(others)} in {ONTO_JOINTS}"
            fail(location(mesh), told, "each has one that stands for it", "run 'ssilk rig --onto' again")
        garment = read_garment(stage, skeleton, garment=str(mesh.GetPath()), root=prim)
        found.append(PutOn(garment, dict(zip(own, others))))
    return found
