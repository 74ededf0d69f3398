# SPDX-License-Identifier: Apache-2.0
"""Convert between the units and axes of a stage and metres, y up.

A change of units and axes rotates and scales the world, not the joints. In a joint hierarchy it changes the
transforms of the roots, and only the lengths of the translations of all other joints.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ssilk_core.errors import fail
from ssilk_core.scene.assets import Floats

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
        """Read the units of `stage`; USD's defaults are centimetres and y up.

        Raises:
            SsilkError: metersPerUnit is not positive, or the up axis is neither Y nor Z.
        """
        from pxr import UsdGeom

        where, meters = stage.GetRootLayer().identifier, UsdGeom.GetStageMetersPerUnit(stage)
        if not 0 < meters < np.inf:
            fail(where, f"metersPerUnit is {meters}", "it must be positive", "set it in the file")
        axis = str(UsdGeom.GetStageUpAxis(stage))
        if axis not in _TO_Y_UP:
            fail(where, f"upAxis is '{axis}'", "it must be Y or Z", "set it in the file")
        return cls(meters, axis)

    @property
    def rotation(self) -> Floats:
        """Rotation from the stage's axes to y up, shape (3, 3)."""
        return _TO_Y_UP[self.up_axis]

    @property
    def matrix(self) -> Floats:
        """Transform from stage world to core world [m], column vectors, shape (4, 4)."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation * self.meters_per_unit
        return matrix

    def points_to_core(self, points: Floats) -> Floats:
        """Convert points (..., 3) from the stage's units and axes to metres, y up."""
        return np.asarray(points) @ self.rotation.T * self.meters_per_unit

    def transforms_to_core(self, transforms: Floats) -> Floats:
        """Convert rigid joint-to-world transforms (..., 4, 4) from the stage's units and axes to metres, y up."""
        return self.matrix @ transforms @ scaling(1 / self.meters_per_unit)

    def points_from_core(self, points: Floats) -> Floats:
        """Convert points or offsets (..., 3) from metres, y up, to the stage's units and axes."""
        return np.asarray(points) @ self.rotation / self.meters_per_unit

    def transforms_from_core(self, transforms: Floats) -> Floats:
        """Convert rigid joint-to-world transforms (..., 4, 4) from metres, y up, to the stage's units and axes."""
        return np.linalg.inv(self.matrix) @ transforms @ scaling(self.meters_per_unit)


def scaling(factor: float) -> Floats:
    """Return the uniform scaling matrix, shape (4, 4)."""
    return np.diag([factor, factor, factor, 1.0])
