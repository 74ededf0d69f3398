# SPDX-License-Identifier: Apache-2.0
"""Fabrics in training: each window and each single pose has one, drawn within a range.

Of these, `OWN` are the model's own fabric and `MIXED` mixtures of the presets that the range spans, on a logarithmic
scale; all others have factors that are drawn independently, evenly on that scale.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ..scene.fabric_range import FACTORS, FabricRange, inputs_of
from ..scene.fabrics import Fabric

OWN, MIXED = 0.2, 0.4
CHANGED = 0.05  # chance that a window that continues another has another fabric, as where an artist turns a slider


class FabricDrawer:
    """Draws fabrics as the features that networks see."""

    def __init__(self, fabrics: FabricRange, own: Fabric, generator: torch.Generator, device: torch.device) -> None:
        presets = [inputs_of(fabrics.factors_of(own, name)) for name in fabrics.presets]

        def tensor(values: object) -> Tensor:
            return torch.as_tensor(np.array(values), dtype=torch.float32, device=device)

        self.generator, self.device = generator, device
        self.presets = tensor([np.zeros(len(FACTORS)), *presets]) if presets else None
        self.low, self.high = (tensor(bound) for bound in fabrics.bounds)

    def draw(self, count: int) -> Tensor:
        """Return features (count, 5)."""
        even, chance = self._uniform(count, len(FACTORS)), self._uniform(count, 1)
        found = self.low + even * (self.high - self.low)
        if self.presets is not None:
            # Squares of exponential weights prefer one or two of them.
            weights = self._uniform(count, len(self.presets)).clamp_min(1e-7).log() ** 2
            mixed = (weights / weights.sum(1, keepdim=True)) @ self.presets
            found = torch.where(chance < OWN + MIXED, mixed, found)
        return torch.where(chance < OWN, torch.zeros_like(found), found)

    def _uniform(self, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=self.generator, device=self.device)

    def changed(self, count: int) -> Tensor:
        """Return which of so many windows have another fabric than those that they continue, (count, 1)."""
        return self._uniform(count, 1) < CHANGED
