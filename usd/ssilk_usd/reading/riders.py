# SPDX-License-Identifier: Apache-2.0
"""Read what rides on a garment: prims of a character's stage with `ssilk:ridesOn`, a relationship to its mesh."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import takewhile

import numpy as np
from pxr import Usd, UsdGeom

from ssilk_core.errors import fail
from ssilk_core.events import Message, Reporter, silent
from ssilk_core.scene.assets import Mesh

from ..names import RIDE_SOFT, RIDE_VERTICES, RIDES_ON, SKEL
from ..opening.stage import (
    PRIMS,
    StageLike,
    has_value,
    inherited,
    listed,
    location,
    needs_whole_files,
    open_stage,
    value,
    world_matrix,
)
from ..opening.times import change_times, xform_attributes
from .mesh import is_drawn, is_garment, is_stand_in, read_mesh
from .skeleton import find_skeleton

TODO = "name the mesh of one garment in ssilk:ridesOn"


@dataclass(frozen=True, eq=False)
class SaidRider:
    """What a stage says of a rider.

    Attributes:
        path: "file:/Prim/Path", for messages.
        name: of its prim.
        meshes: at the bind pose, in the core's bind space [m].
        vertices: those of the garment that carry it; None where these are to be found.
        soft: it goes with the cloth beneath each of its points.
    """

    path: str
    name: str
    meshes: tuple[Mesh, ...]
    vertices: tuple[int, ...] | None
    soft: bool


@needs_whole_files
def read_riders(
    source: StageLike, garment: str, *, root: str | None = None, report: Reporter = silent
) -> tuple[SaidRider, ...]:
    """Return what rides on a garment, in the order of the stage.

    A rider is one rigid thing, of all meshes that are drawn beneath its prim, and lies where it is to lie on the
    garment in the character's bind pose.

    Args:
        source: the character's file or stage.
        garment: path of the garment's mesh; where the stage has no such prim, its name tells.
        root: the character, if the stage has several.
        report: hears of riders of other garments, and of motion that a rider has of its own: both are left out.

    Raises:
        SsilkError: a rider rides on no garment or on several, has no mesh, or is skinned itself.
    """
    stage = open_stage(source)
    prims, found = iter(Usd.PrimRange.Stage(stage, PRIMS)), []
    for prim in prims:
        rides_on = prim.GetRelationship(RIDES_ON)
        targets = rides_on.GetForwardedTargets() if rides_on else []
        if not targets:
            continue
        prims.PruneChildren()
        if len(targets) > 1:
            found_text = f"it rides on {len(targets)} prims, {', '.join(map(str, targets))}"
            fail(location(prim), found_text, "a rider has one garment beneath it", TODO)
        target = stage.GetPrimAtPath(targets[0])
        known = stage.GetPrimAtPath(garment) if garment.startswith("/") else None
        if targets[0] == garment or (not known and targets[0].name == garment.rpartition("/")[2]):
            found.append(_read(prim, stage, root, report))
        elif target and is_garment(target):
            text = f"it rides on {targets[0]}, another garment than is baked here, and is left out"
            report(Message(f"{location(prim)}: {text}"))
        else:
            what = "is no garment" if target else "is not in the stage"
            fail(location(prim), f"it rides on {targets[0]}, which {what}", f"the garment is {garment}", TODO)
    return tuple(found)


def _read(prim: Usd.Prim, stage: Usd.Stage, root: str | None, report: Reporter) -> SaidRider:
    where, skel = location(prim), find_skeleton(stage, root=root)
    meshes = [
        each
        for each in Usd.PrimRange(prim, PRIMS)
        if each.IsA(UsdGeom.Mesh) and is_drawn(each) and not is_stand_in(each)
    ]
    if not meshes:
        fail(where, "it rides on a garment and has no visible mesh", "one is needed", "take ssilk:ridesOn away")
    if worn := [each for each in meshes if is_garment(each)]:
        fail(where, f"{listed(worn)} is a garment", "a garment moves by itself", "take ssilk:ridesOn away")
    if skinned := [each for each in meshes if inherited(each, SKEL[0]) is not None]:
        todo = "remove its joint indices and weights, or take ssilk:ridesOn away"
        fail(where, f"{listed(skinned)} is skinned itself", "what rides on a garment has no influences", todo)
    if moving := [each for each in meshes if _moves(each, skel.root)]:
        text = f"{listed(moving)} moves by itself, which is left out: it rides as it lies at the first time"
        report(Message(f"{where}: {text}", "warning"))
    to_core = skel.bind_to_core @ skel.world_to_bind
    vertices = None
    if has_value(prim, RIDE_VERTICES):
        named = np.ravel(value(prim, RIDE_VERTICES))
        if named.dtype.kind not in "iu":
            fail(where, f"{RIDE_VERTICES} is {str(named.tolist())[:40]}", "three whole numbers are needed")
        vertices = tuple(int(each) for each in named)
    soft = value(prim, RIDE_SOFT) is True
    if soft and vertices is not None:
        fail(where, f"it has {RIDE_SOFT} and {RIDE_VERTICES}", "three vertices carry what is rigid", "remove one")
    read = tuple(read_mesh(each, to_core @ world_matrix(each)) for each in meshes)
    return SaidRider(where, prim.GetName(), read, vertices, soft)


def _moves(prim: Usd.Prim, root: Usd.Prim) -> bool:
    """Return whether a mesh moves within its character, or changes its points."""
    above = {attribute.GetPath() for attribute in xform_attributes(root)}
    own = takewhile(lambda attribute: attribute.GetPath() not in above, xform_attributes(prim))
    return len(change_times([UsdGeom.Mesh(prim).GetPointsAttr(), *own])) > 1
