# SPDX-License-Identifier: Apache-2.0
"""What a shot says of what was counted in it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from ...errors import fail
from ...physics.intersections.figures import NOT_COUNTED, SelfIntersections
from ...physics.skin.figures import ShownSkin
from ...physics.world.sunk import SunkCloth
from ...scene.plain import from_plain
from .entered import EnteredCloth
from .opened import provenance_of
from .shots import finished, is_stage, place_of

Counts = TypeVar("Counts", ShownSkin, SunkCloth)

# Under these names.
SHOWN_SKIN, INTERSECTIONS, SUNK, ENTERED = "shown_skin", "intersections", "sunk_cloth", "riders_in_cloth"


@dataclass(frozen=True, kw_only=True)
class ShotCounts:
    """What was counted in a written file.

    Attributes:
        shown_skin: the share of the covered skin that shows; None where the garment covers nothing.
        intersections: the share of triangles that intersect others of the garment; None without libigl.
        sunk: the share of vertices inside colliders; None where there are no colliders.
        entered: riders that enter their cloth.
    """

    shown_skin: ShownSkin | None
    intersections: SelfIntersections | None
    sunk: SunkCloth | None = None
    entered: tuple[EnteredCloth, ...] = ()

    def to_metadata(self) -> dict[str, object]:
        """Return what a shot says of them. Where cloth was not counted, it says why."""
        skin = {SHOWN_SKIN: self.shown_skin.to_metadata()} if self.shown_skin else {}
        cloth = self.intersections.to_metadata() if self.intersections else {"none": NOT_COUNTED}
        sunk = {SUNK: self.sunk.to_metadata()} if self.sunk else {}
        entered = {ENTERED: {each.rider: each.to_metadata() for each in self.entered}} if self.entered else {}
        return {**skin, INTERSECTIONS: cloth, **sunk, **entered}


def stated_sunk(path: Path, garments: Mapping[int, str]) -> dict[int, SunkCloth]:
    """Return what bakes counted inside colliders; arguments and errors are those of `stated_skin`."""
    what = "cloth inside colliders"
    return _stated(path, garments, SUNK, what, lambda said: from_plain(SunkCloth, {"colliders": {}, **said}))


def stated_skin(path: Path, garments: Mapping[int, str]) -> dict[int, ShownSkin]:
    """Return what bakes counted of skin and limbs, of garments of a shot or of a stage of layers that have it.

    Args:
        garments: paths of their meshes in the stage, by any number.

    Raises:
        SsilkError: not a readable shot, or it says so otherwise than this version does.
    """
    none: dict[str, object] = {"regions": {}, "limbs": {}}  # USD keeps no empty dictionaries
    return _stated(path, garments, SHOWN_SKIN, "skin", lambda said: from_plain(ShownSkin, {**none, **said}))


def _stated(
    path: Path, garments: Mapping[int, str], name: str, what: str, parsed: Callable[[Mapping[str, object]], Counts]
) -> dict[int, Counts]:
    if is_stage(path):
        field = {SUNK: "sunk", SHOWN_SKIN: "shown_skin"}[name]
        records = finished(*place_of(path))
        results = {shot: getattr(record.result, field) for shot, record in records.items() if record}
        prims = {number: prim.split("/")[2:3] for number, prim in garments.items()}
        return {number: found for number, prim in prims.items() if prim and (found := results.get(prim[0]))}
    said = provenance_of(path).get(name)
    if not isinstance(said, Mapping) or "none" in said or len(garments) != 1:
        return {}
    try:
        found = parsed(said)
    except (TypeError, ValueError) as error:
        fail(str(path), f"its {what} is told in another way ({error})", "a shot of this version", "bake it again")
    return dict.fromkeys(garments, found)
