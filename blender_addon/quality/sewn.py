# SPDX-License-Identifier: GPL-3.0-or-later
"""The shape that a garment's stretch counts from, which on another body of a family need not be where it lies."""

from __future__ import annotations

import bpy
import numpy as np

from ssilk_core.errors import SsilkError

from ..errors import SetupError
from ..playback.bake import LAID
from ..playback.models import facts_of, model_of
from ..scene.meshes import PREFIX
from ..scene.shapes import key_offsets, worn_points


def sewn_points(garment: bpy.types.Object) -> np.ndarray:
    """Return a garment's points at rest as it is sewn, with the size that it has in the world, shape (V, 3).

    It is how the artist has it shaped. Where its model is of a family of bodies, it is how that has it: as on the
    first body, or, if it is graded, as it lies on this one.

    Raises:
        SetupError: its shape keys are absolute.
    """
    points, to_world = worn_points(garment), np.array(garment.matrix_world)[:3, :3].T
    try:
        sewing = facts_of(model_of(garment)).sewing
    except (SetupError, SsilkError, OSError):  # it has no model yet, or none that can be read
        sewing = None
    if sewing is None or len(sewing.first) != len(points):
        return points @ to_world
    if not sewing.graded:
        return sewing.first / bpy.context.scene.unit_settings.scale_length
    keys = garment.data.shape_keys
    laid = (
        [key for key in keys.key_blocks if key.name == PREFIX + LAID and key.value and not key.mute] if keys else []
    )
    return (points + sum(key_offsets(garment, laid))) @ to_world
