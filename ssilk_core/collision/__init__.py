# SPDX-License-Identifier: Apache-2.0
"""The posed body, and the distance of garment vertices to it.

Positions have the shape (V, 3, N): vertices, coordinates, frames.
"""

from .body import CollisionBody
from .contacts import Contacts
from .distance import (
    Patches,
    PosedBody,
    nearest_planes,
    signed_distance,
    signed_distance_to_planes,
    smoothed_planes,
)
from .reach import ReachableBody, reachable_body
from .smoothed_distance import SmoothedDistance

__all__ = [
    "CollisionBody",
    "Contacts",
    "Patches",
    "PosedBody",
    "ReachableBody",
    "SmoothedDistance",
    "nearest_planes",
    "reachable_body",
    "signed_distance",
    "signed_distance_to_planes",
    "smoothed_planes",
]
