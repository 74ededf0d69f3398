# SPDX-License-Identifier: Apache-2.0
"""Gravity as part of the descriptors, as tensors, because training rotates it."""

from __future__ import annotations

import torch
from torch import Tensor


def gravity_features(down: Tensor, direction: Tensor) -> Tensor:
    """Return gravity's unit direction in each joint's frame: down (N, J', 3, 3), direction (N, 3), to (N, 3 J')."""
    return torch.einsum("njab,nb->nja", down, direction).flatten(1)
