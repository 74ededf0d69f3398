# SPDX-License-Identifier: Apache-2.0
"""The posed body, and the distance of the cloth to it.

Positions have the shape (V, 3, N): vertices, coordinates, frames. A garment meets the body in this order:

1. `physics.reach`: once, the part of the body that the garment can touch; `body` poses that part in each frame.
2. `physics.samples`: once, the points of the cloth at which it meets the body, each with the area that it stands
   for; `sampled_cloth` has their positions.
3. `contacts`: each sample asks for the plane that it can touch: loose cloth the whole body, tight cloth the patch
   beneath it (`patches`).
4. `distance` answers: the nearest vertex (`nearest_vertex`), then the nearest point on the triangles around it
   (`one_ring`) or on all triangles (`closest_point`). `smoothed_distance` blends points that are equally near.
5. `pierced`: where the axis of a limb (`limb_axes`) crosses loose cloth (`ray_casting`), it replaces the planes by
   ones that push the cloth off the limb's tip.

`inner_cloth` does the same for garments beneath a garment: a sample meets whatever it lies deepest in.

The energy of contact with these planes is in `energy/collision.py`. After refinement `refine/clearing.py` lifts cloth
off skin that still shows. `winding_number` tells whether a point lies inside the body.
"""

from .body import CollisionBody
from .contacts import Contacts
from .distance import Patches, PosedBody, nearest_planes, signed_distance, signed_distance_to_planes, smoothed_planes
from .limb_axes import LimbAxes, PosedLimbs, limb_axes
from .ray_casting import RayCaster, RayHits
from .smoothed_distance import SmoothedDistance

__all__ = [
    "CollisionBody",
    "Contacts",
    "LimbAxes",
    "Patches",
    "PosedBody",
    "PosedLimbs",
    "RayCaster",
    "RayHits",
    "SmoothedDistance",
    "limb_axes",
    "nearest_planes",
    "signed_distance",
    "signed_distance_to_planes",
    "smoothed_planes",
]
