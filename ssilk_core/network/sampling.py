# SPDX-License-Identifier: Apache-2.0
"""Interpolate garment poses between frames."""

from __future__ import annotations

import numpy as np

from ..scene.assets import Floats, GarmentPose
from ..scene.kinematics import slerp


def sample_pose(pose: GarmentPose, position: Floats, start: int = 0) -> GarmentPose:
    """Return poses at fractional frames `position` (N,), counted from the first frame of `pose`.

    Rotations are interpolated by slerp, translations and weights linearly. `start` is the first frame of the result
    in its shot.
    """
    low = np.minimum(position.astype(int), pose.frame_count - 1)
    high = np.minimum(low + 1, pose.frame_count - 1)
    t = position - low
    rotations = slerp(pose.rotations[low], pose.rotations[high], t[:, None])

    def between(values: Floats) -> Floats:
        share = t.reshape(-1, *[1] * (values.ndim - 1))
        return values[low] * (1 - share) + values[high] * share

    moved = None if pose.translations is None else between(pose.translations)
    return GarmentPose(start, rotations, between(pose.weights).clip(0, 1), moved)
