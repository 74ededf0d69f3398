# SPDX-License-Identifier: Apache-2.0
"""Check whether the units and axes of a file are plausible."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...scene.assets import Mesh
from .finding import Finding, Findings
from .fit import SCALES, UnitCorrection

PLAUSIBLE_HEIGHTS = (0.3, 3.5)  # [m] of characters, from puppets to giants
USUAL_HEIGHT = 1.7  # [m]
LYING_RATIO = 2.0  # ratio of depth to height above which a figure is not upright


@dataclass(frozen=True)
class FileUnits:
    """Units of a file, and whether each is authored or a default of USD."""

    path: str
    meters_per_unit: float
    up_axis: str
    meters_authored: bool
    axis_authored: bool

    def corrected(self, guess: UnitCorrection | None) -> FileUnits:
        """Return the units with unauthored values filled in: from `guess`, or else as read."""
        scale, up = (guess.scale, guess.up) if guess else (1.0, "")
        meters = self.meters_per_unit if self.meters_authored else self.meters_per_unit * scale
        axis = self.up_axis if self.axis_authored else up or self.up_axis
        return FileUnits(self.path, meters, axis, True, True)

    def allows(self, guess: UnitCorrection | None) -> bool:
        """Return whether there is a guess, and it contradicts no authored value."""
        if guess is None:
            return False
        return not (guess.scale != 1 and self.meters_authored) and not (guess.up and self.axis_authored)


def unauthored_units(units: FileUnits) -> Findings:
    """Yield a warning for each of metersPerUnit and upAxis that a file does not author."""
    missing = {
        f"metersPerUnit is not authored; {units.meters_per_unit:g} m is assumed": units.meters_authored,
        f"upAxis is not authored; {units.up_axis} is assumed": units.axis_authored,
    }
    for found, authored in missing.items():
        if not authored:
            yield Finding(
                severity="warning",
                code="units",
                prim=units.path,
                found=found,
                why="gravity and stiffness are physical: at a wrong scale cloth moves too slowly or too fast",
                fix="set both in the file",
                fixable=True,
            )


def body_size(body: Mesh, units: FileUnits) -> Findings:
    """Yield an implausible height of the character, with the units that would make it plausible."""
    height = float(np.ptp(body.points[:, 1]))
    guess = find_upright_units(body)
    plausible = PLAUSIBLE_HEIGHTS[0] <= height <= PLAUSIBLE_HEIGHTS[1]
    if not plausible or (guess and guess.up):
        hint = f"; it is plausible with metersPerUnit {units.meters_per_unit * guess.scale:g}" if guess else ""
        hint += f" and upAxis {guess.up}" if guess and guess.up else ""
        yield Finding(
            severity="warning" if plausible else "error",  # some characters lie down or walk on four legs
            code="character-size",
            prim=body.path,
            found=f"the character is {height:.3g} m high and {np.ptp(body.points[:, 2]):.3g} m deep{hint}",
            why="gravity and stiffness are physical: cloth is too slow on a giant and too fast on a tiny figure",
            fix=f"set metersPerUnit and upAxis so that it is {PLAUSIBLE_HEIGHTS[0]} to {PLAUSIBLE_HEIGHTS[1]} m high",
            fixable=units.allows(guess),
        )


def find_upright_units(body: Mesh) -> UnitCorrection | None:
    """Return the scale and up axis that make a character upright and of usual height.

    None if it already is, or if no scale does.
    """
    wide, high, deep = np.ptp(body.points, axis=0)
    lying = deep > LYING_RATIO * high and deep > 0.5 * wide
    height = deep if lying else high
    scales = [scale for scale in SCALES if PLAUSIBLE_HEIGHTS[0] <= scale * height <= PLAUSIBLE_HEIGHTS[1]]
    best = min(
        [1.0] if 1.0 in scales else scales, key=lambda scale: abs(np.log(scale * height / USUAL_HEIGHT)), default=None
    )
    if best is None or (best == 1 and not lying):
        return None
    return UnitCorrection(best, "Z" if lying else "")
