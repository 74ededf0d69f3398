# SPDX-License-Identifier: Apache-2.0
"""Read a dressed character from a stage: character, garment and proxy rig."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pxr import Usd, UsdGeom

from ssilk_core.errors import fail
from ssilk_core.events import Message, Reporter, silent
from ssilk_core.files import is_same_file, split_location
from ssilk_core.scene.assets import Character, Garment, ProxyRig, Skeleton

from ..names import PROXIES
from ..opening.stage import (
    PRIMS,
    USD_SUFFIXES,
    StageLike,
    needs_whole_files,
    open_stage,
    stage_name,
    value,
)
from .character import read_character
from .garment import fitted_skeleton, read_garment
from .rig import read_proxy_rig
from .skeleton import character_skeleton, find_skeleton, skeletons


@needs_whole_files
def read_scene(
    source: StageLike,
    *,
    root: str | None = None,
    bodies: Sequence[str] = (),
    garment: str | None = None,
    report: Reporter = silent,
) -> tuple[Character, Garment, ProxyRig | None]:
    """Read a character, one garment, and the garment's proxy rig if it has one.

    Args:
        source: the character's file or open stage.
        root: SkelRoot or Skeleton, by path or name, if there are several.
        bodies: body meshes, as `read_character` takes them.
        garment: a mesh of the stage, by path or name, or "FILE[:/Prim/Path]" for a garment in its own file.
        report: receives a message about each assumption.

    Raises:
        SsilkError: as `read_character`, `read_garment` and `read_proxy_rig`.
    """
    stage = open_stage(source)
    file, prim = split_location(garment) if garment else (None, None)
    names: tuple[str | None, str | None]
    if file and Path(file).suffix in USD_SUFFIXES:
        wardrobe, names = open_stage(file), (prim, None)
        _need_order(stage, wardrobe)
        own = prim if is_same_file(file, stage.GetRootLayer().realPath) else None
        character = read_character(stage, root=root, bodies=bodies, garment=own, report=report)
    else:
        character = read_character(stage, root=root, bodies=bodies, garment=garment, report=report)
        wardrobe, names = stage, (garment, root)
    for opened in dict.fromkeys((stage, wardrobe)):
        _announce_units(opened, report)
    skeleton = character.skeleton
    rig = read_proxy_rig(wardrobe, skeleton, garment=names[0], root=names[1], report=report)
    return character, read_garment(wardrobe, skeleton, garment=names[0], root=names[1], report=report), rig


@needs_whole_files
def read_rigged(source: StageLike) -> list[tuple[Skeleton, Garment, ProxyRig]]:
    """Read each garment of a stage that has proxies, with its rig and the skeleton that the proxies belong to.

    Raises:
        SsilkError: as `read_garment` and `read_proxy_rig`.
    """
    stage = open_stage(source)
    prims = [prim for prim in Usd.PrimRange.Stage(stage, PRIMS) if prim.IsA(UsdGeom.Mesh) and value(prim, PROXIES)]
    found = []
    for prim in prims:
        skeleton, name = character_skeleton(fitted_skeleton(prim) or find_skeleton(stage)), str(prim.GetPath())
        rig = read_proxy_rig(stage, skeleton, garment=name)
        assert rig is not None  # it lists proxies
        found.append((skeleton, read_garment(stage, skeleton, garment=name), rig))
    return found


def _need_order(stage: Usd.Stage, wardrobe: Usd.Stage) -> None:
    """Raise `SsilkError` where the garment's file holds the character, and the stage holds none."""
    if skeletons(wardrobe) and not skeletons(stage):
        fail(
            stage_name(stage),
            f"it holds no Skeleton, and {stage_name(wardrobe)} does",
            "the stage is the character's, and --garment the garment's",
            "stage and garment may have been swapped",
        )


def _announce_units(stage: Usd.Stage, report: Reporter) -> None:
    if not UsdGeom.StageHasAuthoredMetersPerUnit(stage):
        text = f"{stage_name(stage)}: metersPerUnit is not authored; USD's default, centimetres, is used"
        report(Message(text, "warning"))
