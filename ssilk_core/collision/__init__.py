# SPDX-License-Identifier: Apache-2.0
"""The posed body, the distance of garment vertices to it, and the skin that shows.

Positions have the shape (V, 3, N): vertices, coordinates, frames.
"""

from .body import CollisionBody
from .contacts import Contacts
from .covered_skin import CoveredPoints, CoveredSkin, ShownCounts, SkinStates
from .distance import (
    Patches,
    PosedBody,
    nearest_planes,
    signed_distance,
    signed_distance_to_planes,
    smoothed_planes,
)
from .limb_axes import LimbAxes, PosedLimbs, limb_axes
from .ray_casting import RayCaster, RayHits
from .reach import ReachableBody, reachable_body
from .smoothed_distance import SmoothedDistance

__all__ = [
    "CollisionBody",
    "Contacts",
    "CoveredPoints",
    "CoveredSkin",
    "LimbAxes",
    "Patches",
    "PosedBody",
    "PosedLimbs",
    "RayCaster",
    "RayHits",
    "ReachableBody",
    "ShownCounts",
    "SkinStates",
    "SmoothedDistance",
    "limb_axes",
    "nearest_planes",
    "reachable_body",
    "signed_distance",
    "signed_distance_to_planes",
    "smoothed_planes",
]
