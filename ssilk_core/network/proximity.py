# SPDX-License-Identifier: Apache-2.0
"""What the network knows of colliders: the nearest one to each of a few points of the cloth.

The points are spread over the cloth that is not pinned, where it would rest in the pose without colliders: in P's
state, decoded. With X such a point, d the distance from it to the nearest collider, negative inside, and n the
direction away from that, `Motion.proximity` holds n, d / D and c = n . (X - o) - d [m], with the garment's diagonal D
and the root's position o. So a point x about the root is c - n . x below the plane of the collider there.

P and S see, in the root's frame as they see gravity in those of joints,

    p = n max(1 - d / r, 0)^2 outside,    p = n min(1 - 2 d / D, 2) inside

with r a tenth of D. So what the cloth would not touch at rest does not change where it rests. Colliders are looked
for up to D: they also stop what S sees of moving cloth (`network.feedback`), which may be far from rest. All this
depends on the pose alone, so that P knows where cloth comes to rest, and a garment at rest stays there.
"""

from __future__ import annotations

import numpy as np

from ..scene.assets import PINNED, Floats, Ints, Scene
from .feedback import spread_vertices
from .settings import ModelConfig

MOST = 2.0  # length of a vector, half a diagonal inside a collider
PLANE = (0, 1, 2, 4)  # columns n and c of proximity
NEAR = 0.1  # of the diagonal, from which on colliders do not change where cloth rests


def proximity_vertices(scene: Scene, config: ModelConfig) -> Ints:
    """Return the vertices whose proximity to colliders a network sees, shape (M,); empty where it sees none."""
    return spread_vertices(scene, config.proximity_points)


def proximity_size(scene: Scene, config: ModelConfig) -> int:
    """Return the number of features: three for each of `proximity_vertices`."""
    return 3 * min(config.proximity_points, int((scene.classes != PINNED).sum()))


def sees_at(features: int) -> tuple[str, str]:
    """Return what is allowed where a motion has the proximity of another garment, and what to do."""
    return f"this network sees it at {features // 3}", "look for colliders at this garment's own points, or at none"


def proximity_reach(scene: Scene) -> float:
    """Return the distance from which on colliders are not seen [m]."""
    return scene.garment.sewn_mesh.diagonal  # one for all bodies of a family


def proximity(points: Floats, distance: Floats, normal: Floats, origin: Floats, reach: float) -> Floats:
    """Return the proximity (..., M, 5) of frames, as `Motion` holds it.

    Args:
        points: at which colliders are seen [m], shape (..., M, 3).
        distance: to the nearest one [m], shape (..., M); infinite where none was found.
        normal: directions away from it, shape (..., M, 3); zero where none was found.
        origin: position of the root [m], shape (..., 3).
        reach: of `proximity_reach`.
    """
    distance = np.minimum(distance, reach)
    height = (normal * (points - origin[..., None, :])).sum(axis=-1) - distance
    return np.concatenate([normal, distance[..., None] / reach, height[..., None]], axis=-1)


def proximity_vectors(values: Floats) -> Floats:
    """Return the vectors (..., 3) that the network sees, from proximity (..., 5)."""
    share = values[..., 3:4]
    length = np.where(share > 0, np.maximum(1 - share / NEAR, 0) ** 2, np.minimum(1 - 2 * share, MOST))
    return values[..., :3] * length
