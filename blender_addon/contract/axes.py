# SPDX-License-Identifier: GPL-3.0-or-later
"""From Blender's world to ssilk's and back: metres, y up, as `ssilk_usd.units` has it; numpy alone."""

from __future__ import annotations

import numpy as np

TO_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def to_core(transforms: np.ndarray, meters_per_unit: float) -> np.ndarray:
    """Return rigid transforms to the world, shape (..., 4, 4), as ssilk has them [m]."""
    found = np.array(transforms, dtype=np.float64)
    found[..., :3, :] = TO_Y_UP @ found[..., :3, :]
    found[..., :3, 3] *= meters_per_unit
    return found


def from_core(transforms: np.ndarray, meters_per_unit: float) -> np.ndarray:
    """Invert `to_core`."""
    found = np.array(transforms, dtype=np.float64)
    found[..., :3, :] = TO_Y_UP.T @ found[..., :3, :]
    found[..., :3, 3] /= meters_per_unit
    return found


def points_from_core(points: np.ndarray, meters_per_unit: float) -> np.ndarray:
    """Return points or offsets [m], shape (..., 3), in Blender's world."""
    return points @ TO_Y_UP / meters_per_unit
