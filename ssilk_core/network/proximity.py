# SPDX-License-Identifier: Apache-2.0
"""What the network sees of colliders: how near they are to points of the garment, as its body carries them.

Each of a few points, spread over the cloth that is not pinned, is carried by linear blend skinning. With d the
distance from it to the nearest collider, negative inside, n the direction away from that, and r the reach,

    p = n max(1 - d / r, 0)^2 outside,    p = n min(1 - 2 d / r, 2) inside

is zero where nothing is near, has length one where the body would carry the point onto a collider, and is smooth.
`Motion.proximity` holds these vectors in the world; the network sees them in the root's frame, as it sees gravity in
those of joints. They depend on the pose alone, so that P knows where cloth comes to rest, a garment at rest stays
there, and a step costs what it costs without. The reach is the garment's diagonal: the hem of a cape may hang so far
below the shoulders, wherever the body would carry it.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from ..scene.assets import PINNED, Floats, Ints, Motion, Scene, ShotWorld
from .feedback import spread_vertices
from .settings import ModelConfig

MOST = 2.0  # length of a vector, half a reach inside a collider


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
    return scene.garment.mesh.diagonal


def proximity(distance: Floats, normal: Floats, reach: float) -> Floats:
    """Return vectors (..., 3) from distances (...,) [m] and directions away from colliders (..., 3)."""
    share = 1 - distance / reach
    length = np.where(distance > 0, np.maximum(share, 0) ** 2, np.minimum(2 * share - 1, MOST))
    return normal * length[..., None]


def nearest_planes(vectors: Floats, reach: float) -> tuple[Floats, Floats]:
    """Return directions away from colliders (..., 3) and distances (...,) [m] from vectors (..., 3) of `proximity`.

    Where nothing is near the direction is zero, and the distance that of the reach. No point is deeper inside than
    half the reach.
    """
    length = np.linalg.norm(vectors, axis=-1)
    direction = vectors / np.maximum(length, np.finfo(float).tiny)[..., None]
    return direction, reach * np.where(length < 1, 1 - np.sqrt(length), (1 - length) / 2)


def seen_proximity(world: ShotWorld | None, motion: Motion, scene: Scene, config: ModelConfig) -> Floats | None:
    """Return what a network sees of the colliders of a shot in each frame of a motion, as `Motion.proximity`.

    Args:
        world: whose time runs from the first frame of the motion; None for none.
    """
    from ..physics.world.felt import felt_proximity

    reach = proximity_reach(scene)
    rows = proximity_vertices(scene, config)
    return felt_proximity(world, motion, scene, rows, reach, partial(proximity, reach=reach))
