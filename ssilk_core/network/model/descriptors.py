# SPDX-License-Identifier: Apache-2.0
"""Gravity as part of the descriptors, as tensors, because training rotates it."""

from __future__ import annotations

import torch
from torch import Tensor

from ...scene.assets import Floats
from ..descriptors import PoseFeatures

DOWN = (0.0, -1.0, 0.0)  # where gravity points, but in training


def upright_descriptors(features: PoseFeatures, like: Tensor) -> tuple[Tensor, Tensor]:
    """Return static descriptors (F, S) and dynamic ones (F, D) of frames under gravity along -y, as `like` is."""

    def tensor(values: Floats) -> Tensor:
        return torch.as_tensor(values).to(like)

    gravity = gravity_features(tensor(features.down), like.new_tensor(DOWN).expand(len(features.static), 3))
    static = torch.cat([tensor(features.static), gravity], dim=1)
    return static, torch.cat([static, tensor(features.dynamic)], dim=1)


def gravity_features(down: Tensor, direction: Tensor) -> Tensor:
    """Return gravity's unit direction in each joint's frame: down (N, J', 3, 3), direction (N, 3), to (N, 3 J')."""
    return torch.einsum("njab,nb->nja", down, direction).flatten(1)
