# SPDX-License-Identifier: Apache-2.0
"""Read how an animator directs a garment: where it is held to linear blend skinning, how long each pose is held, and
whether the shot is a cycle.

All are attributes of the garment's prim, in the shot or in the character's stage: `ssilk:free`, a number that may be
keyed, `ssilk:hold`, a whole number, and `ssilk:loop`, a bool. A shot that plays a clip alone may have an `over` at
the garment's path.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pxr import Usd, UsdGeom, UsdSkel

from ssilk_core.errors import fail
from ssilk_core.files import split_location
from ssilk_core.scene.assets import Floats, Motion
from ssilk_core.scene.kinematics import MAX_HOLD

from ..names import FREE, HOLD, LOOP
from ..opening.stage import PRIMS, explains_damage, has_value, listed, location, open_stage
from ..opening.times import change_times
from .mesh import is_garment
from .motion import find_animation

ROUNDING = 1e-6


@dataclass(frozen=True, eq=False)
class SaidDirection:
    """What stages say.

    Attributes:
        free: at each frame of the motion, 0 to 1, shape (F,); None where it is 1 throughout.
        hold: frames that each pose is held.
    """

    free: Floats | None
    hold: int


@explains_damage
def read_direction(source: str, stage: str, garment: str, motion: Motion) -> SaidDirection:
    """Return how a garment is directed over a motion.

    Args:
        source: of the motion, "file[:/Prim/Path]".
        stage: the character's file.
        garment: path of the garment in it.

    Raises:
        SsilkError: a value is no number or out of range, or several prims of the shot may be the garment.
    """
    file, _ = split_location(source)
    shot, home = open_stage(file), open_stage(stage)
    prims = _prims(shot, home, source, garment, motion)
    free = next((prim for prim in prims if has_value(prim, FREE)), None)
    hold = next((prim for prim in prims if has_value(prim, HOLD)), None)
    seconds = (motion.start + np.arange(motion.frame_count)) / motion.fps
    return SaidDirection(_free(free, seconds) if free else None, _hold(hold) if hold else 1)


@explains_damage
def read_loop(source: str, stage: str, garment: str, motion: Motion) -> bool:
    """Return whether a shot is said to be a cycle; arguments and errors as `read_direction`."""
    file, _ = split_location(source)
    shot, home = open_stage(file), open_stage(stage)  # prims live as long as these
    prim = next((prim for prim in _prims(shot, home, source, garment, motion) if has_value(prim, LOOP)), None)
    if prim is None:
        return False
    found = prim.GetAttribute(LOOP).Get()
    if change_times([prim.GetAttribute(LOOP)]) or not isinstance(found, bool):
        fail(location(prim), f"{LOOP} is {str(found)[:40]}", "true or false is needed, without time samples")
    return found


def _prims(shot: Usd.Stage, home: Usd.Stage, source: str, garment: str, motion: Motion) -> list[Usd.Prim]:
    """Return the garment's prims in the shot, then in the character's stage."""
    _, placed = find_animation(shot, split_location(source)[1] or split_location(motion.path)[1], None)
    return [*_in_shot(shot, garment, placed), *filter(None, [home.GetPrimAtPath(garment)])]


def _in_shot(shot: Usd.Stage, garment: str, placed: Usd.Prim | None) -> list[Usd.Prim]:
    """Return the garment's prim in a shot; none where the shot has no such prim."""
    root = UsdSkel.Root.Find(placed).GetPrim() if placed else None
    name = garment.rsplit("/", 1)[-1]
    worn = [
        prim
        for prim in (Usd.PrimRange(root, PRIMS) if root else ())
        if prim.IsA(UsdGeom.Mesh) and prim.GetName() == name and is_garment(prim)
    ]
    if len(worn) > 1:
        what = f"several garments may be {name}: {listed(worn)}"
        fail(str(shot.GetRootLayer().identifier), what, "one is needed", "rename or deactivate the others")
    there = shot.GetPrimAtPath(garment)
    return worn or ([there] if there else [])


def _free(prim: Usd.Prim, seconds: Floats) -> Floats | None:
    attribute, second = prim.GetAttribute(FREE), prim.GetStage().GetTimeCodesPerSecond()
    codes = seconds * second if change_times([attribute]) else seconds[:1] * second
    found = [attribute.Get(Usd.TimeCode(float(code))) for code in codes]
    try:
        values = np.array(found, dtype=float)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.shape != codes.shape:
        fail(location(prim), f"{FREE} is {str(found[0])[:40]}", "a number from 0 to 1 is needed")
    bad = ~((values >= -ROUNDING) & (values <= 1 + ROUNDING))
    if bad.any():
        at = int(np.argmax(bad))
        allowed = "0, held to linear blend skinning, to 1, free, are allowed"
        fail(location(prim), f"{FREE} is {values[at]:g} at time code {codes[at]:g}", allowed)
    values = np.broadcast_to(values.clip(0, 1), seconds.shape)
    return None if (values == 1).all() else values


def _hold(prim: Usd.Prim) -> int:
    attribute = prim.GetAttribute(HOLD)
    if change_times([attribute]):
        fail(location(prim), f"{HOLD} changes over time", "a shot has one", "give it a value without time samples")
    found = attribute.Get()
    number = isinstance(found, int | float) and not isinstance(found, bool)
    if not (number and 1 <= found <= MAX_HOLD and found == int(found)):
        allowed = f"a whole number of frames from 1 to {MAX_HOLD} is needed"
        fail(location(prim), f"{HOLD} is {str(found)[:40]}", allowed)
    return int(found)
