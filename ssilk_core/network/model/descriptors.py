# SPDX-License-Identifier: Apache-2.0
"""Gravity as part of the descriptors, as tensors, because training rotates it."""

from __future__ import annotations

import torch
from torch import Tensor

from ...scene.assets import Floats
from ..descriptors import VECTORS, PoseFeatures
from ..proximity import MOST, NEAR

DOWN = (0.0, -1.0, 0.0)  # where gravity points, but in training


def motion_descriptors(features: PoseFeatures, like: Tensor) -> tuple[Tensor, Tensor]:
    """Return static descriptors (F, S) and dynamic ones (F, D) of frames in their own surroundings, as `like` is.

    Where no colliders are looked for, both lack the features of proximity (`GarmentModel.completed`).
    """

    def tensor(values: Floats) -> Tensor:
        return torch.as_tensor(values).to(like)

    gravity = like.new_tensor(DOWN).expand(len(features.static), 3)
    if features.gravity is not None:
        gravity = tensor(features.gravity)
    static = torch.cat([tensor(features.static), gravity_features(tensor(features.down), gravity)], dim=1)
    if features.proximity is not None:
        static = torch.cat([tensor(features.proximity), static], dim=1)
    earlier = gravity_features(tensor(features.earlier), gravity)
    return static, torch.cat([static, earlier, tensor(features.dynamic)], dim=1)


def turned_vectors(dynamic: Tensor, direction: Tensor, heading: Tensor) -> Tensor:
    """Return absolute features (N, D) of the motion turned as a whole about the origin of the world.

    Args:
        direction: of gravity (N, 3), which the rotation turns to -y.
        heading: directions (N, 3), whose part across gravity it turns to x.
    """
    direction = torch.nn.functional.normalize(direction, dim=1)
    across = heading - (heading * direction).sum(1, keepdim=True) * direction
    x, y = torch.nn.functional.normalize(across, dim=1), -direction
    rotation = torch.stack([x, y, torch.linalg.cross(x, y, dim=1)], dim=1)
    vectors = dynamic[:, -3 * VECTORS :].reshape(-1, VECTORS, 3)
    return torch.cat([dynamic[:, : -3 * VECTORS], (vectors @ rotation.mT).flatten(1)], dim=1)


def gravity_features(down: Tensor, gravity: Tensor) -> Tensor:
    """Return gravity in each joint's frame: down (N, J', 3, 3), gravity as seen (N, 3), to (N, 3 J')."""
    return torch.einsum("njab,nb->nja", down, gravity).flatten(1)


def proximity_length(share: Tensor) -> Tensor:
    """Return the lengths of `network.proximity` at distances that are shares of the garment's diagonal."""
    return torch.where(share > 0, (1 - share / NEAR).clamp_min(0) ** 2, (1 - 2 * share).clamp_max(MOST))


def proximity_features(vectors: Tensor, down: Tensor) -> Tensor:
    """Return vectors (N, M, 3) in the root's frame (N, 3 M), from the world-to-root rotations (N, 3, 3)."""
    return torch.einsum("nab,nmb->nma", down, vectors).flatten(1)


def seen_gravity(units: Tensor) -> Tensor:
    """Return `network.descriptors.seen_gravity` of accelerations (N, 3) in units of the usual gravity."""
    length = torch.linalg.vector_norm(units, dim=1, keepdim=True).clamp_min(1.0)
    return units * ((1 + length.log()) / length)
