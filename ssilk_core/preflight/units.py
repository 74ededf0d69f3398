# SPDX-License-Identifier: Apache-2.0
"""Whether lengths and axes of a file mean what its author meant."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..assets import Mesh
from .finding import Finding, Findings
from .fit import SCALES, Misplacement

HEIGHTS = (0.3, 3.5)  # [m] of characters: from toddlers and puppets to giants
USUAL_HEIGHT = 1.7  # [m]
LYING = 2.0  # times as deep as high: no upright figure


@dataclass(frozen=True)
class FileUnits:
    """What a file says of its units: as read, and whether it says so itself or USD's defaults stepped in."""

    path: str
    meters_per_unit: float
    up_axis: str
    meters_authored: bool
    axis_authored: bool

    def corrected(self, guess: Misplacement | None) -> FileUnits:
        """Return the units with what is not authored filled in: as read, or as a better fit says."""
        scale, up = (guess.scale, guess.up) if guess else (1.0, "")
        meters = self.meters_per_unit if self.meters_authored else self.meters_per_unit * scale
        axis = self.up_axis if self.axis_authored else up or self.up_axis
        return FileUnits(self.path, meters, axis, True, True)

    def open_to(self, guess: Misplacement | None) -> bool:
        """Return whether there is a guess that contradicts nothing authored."""
        if guess is None:
            return False
        return not (guess.scale != 1 and self.meters_authored) and not (guess.up and self.axis_authored)


def unauthored(units: FileUnits) -> Findings:
    """Yield which of metersPerUnit and upAxis a file leaves out."""
    missing = {
        f"metersPerUnit is not authored; its lengths are taken as {units.meters_per_unit:g} m": units.meters_authored,
        f"upAxis is not authored; {units.up_axis} is taken as up": units.axis_authored,
    }
    for found, authored in missing.items():
        if not authored:
            yield Finding(
                severity="warning",
                code="units",
                prim=units.path,
                found=found,
                why="gravity and stiffness are physical: a wrong scale makes cloth move like syrup or like paper",
                fix="set both in the file",
                fixable=True,
            )


def body_size(body: Mesh, units: FileUnits) -> Findings:
    """Yield that the character's height is not that of any figure, with the units that would be."""
    height = float(np.ptp(body.points[:, 1]))
    guess = misread(body)
    plausible = HEIGHTS[0] <= height <= HEIGHTS[1]
    if not plausible or (guess and guess.up):
        hint = f"; it is plausible with metersPerUnit {units.meters_per_unit * guess.scale:g}" if guess else ""
        hint += f" and upAxis {guess.up}" if guess and guess.up else ""
        yield Finding(
            severity="warning" if plausible else "error",  # some characters do lie, or walk on four legs
            code="character-size",
            prim=body.path,
            found=f"the character is {height:.3g} m high and {np.ptp(body.points[:, 2]):.3g} m deep{hint}",
            why="gravity and stiffness are physical: cloth on a giant barely moves, on a thimble it flutters",
            fix=f"set metersPerUnit and upAxis so that it is {HEIGHTS[0]} to {HEIGHTS[1]} m high",
            fixable=units.open_to(guess),
        )


def misread(body: Mesh) -> Misplacement | None:
    """Return the scale and axis that make a character stand upright at a usual height; None where it does."""
    wide, high, deep = np.ptp(body.points, axis=0)
    lying = deep > LYING * high and deep > 0.5 * wide
    height = deep if lying else high
    scales = [scale for scale in SCALES if HEIGHTS[0] <= scale * height <= HEIGHTS[1]]
    best = min(
        [1.0] if 1.0 in scales else scales, key=lambda scale: abs(np.log(scale * height / USUAL_HEIGHT)), default=None
    )
    if best is None or (best == 1 and not lying):
        return None
    return Misplacement(best, "Z" if lying else "")
