# SPDX-License-Identifier: Apache-2.0
"""The descriptors of `ssilk_core.descriptors`, with gravity, which depends on the augmentation, as tensors."""

from __future__ import annotations

import torch
from torch import Tensor


def gravity_features(down: Tensor, direction: Tensor) -> Tensor:
    """Return gravity's unit direction in each joint's frame: down (N, J', 3, 3), direction (N, 3), to (N, 3 J')."""
    return torch.einsum("njab,nb->nja", down, direction).flatten(1)
