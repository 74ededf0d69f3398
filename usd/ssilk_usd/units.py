# SPDX-License-Identifier: Apache-2.0
"""Units and axes of a stage, and the way to metres, y up, and back.

A change of units and axes turns and scales the world, not the joints: of a hierarchy of joints it changes the
roots' transforms, and of all other joints the length of their translations alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ssilk_core.assets import Floats
from ssilk_core.errors import fail

if TYPE_CHECKING:
    from pxr import Usd

_TO_Y_UP = {
    "Y": np.eye(3),
    "Z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
}


@dataclass(frozen=True)
class StageUnits:
    """Length of a stage's unit [m] and its up axis, "Y" or "Z"."""

    meters_per_unit: float = 1.0
    up_axis: str = "Y"

    @classmethod
    def of(cls, stage: Usd.Stage) -> StageUnits:
        """Read the units of `stage`; unauthored ones are USD's own (centimetres, y up).

        Raises:
            SsilkError: metersPerUnit is not positive, or the up axis is neither Y nor Z.
        """
        from pxr import UsdGeom

        where, meters = stage.GetRootLayer().identifier, UsdGeom.GetStageMetersPerUnit(stage)
        if not 0 < meters < np.inf:
            fail(where, f"metersPerUnit is {meters}", "it must be positive", "set it in the file")
        axis = str(UsdGeom.GetStageUpAxis(stage))
        if axis not in _TO_Y_UP:
            fail(where, f"upAxis is '{axis}'", "it is Y or Z", "set it in the file")
        return cls(meters, axis)

    @property
    def rotation(self) -> Floats:
        """Rotation from the stage's axes to y up, shape (3, 3)."""
        return _TO_Y_UP[self.up_axis]

    @property
    def matrix(self) -> Floats:
        """Stage world to core world [m], shape (4, 4), column vectors."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation * self.meters_per_unit
        return matrix

    def points_to_core(self, points: Floats) -> Floats:
        """Return points in the stage's units and axes, shape (..., 3), in metres, y up."""
        return np.asarray(points) @ self.rotation.T * self.meters_per_unit

    def transforms_to_core(self, transforms: Floats) -> Floats:
        """Return rigid joint-to-world transforms of the stage, shape (..., 4, 4), in metres, y up."""
        return self.matrix @ transforms @ scaling(1 / self.meters_per_unit)

    def points_from_core(self, points: Floats) -> Floats:
        """Return points or offsets [m], y up, shape (..., 3), in the stage's units and axes."""
        return np.asarray(points) @ self.rotation / self.meters_per_unit

    def transforms_from_core(self, transforms: Floats) -> Floats:
        """Return rigid joint-to-world transforms [m], y up, shape (..., 4, 4), in the stage's units and axes."""
        return np.linalg.inv(self.matrix) @ transforms @ scaling(self.meters_per_unit)


def scaling(factor: float) -> Floats:
    """Return the matrix (4, 4) that scales by one factor."""
    return np.diag([factor, factor, factor, 1.0])
