# SPDX-License-Identifier: Apache-2.0
"""A record of skipped training steps, kept on the device so that no step waits for the host."""

from __future__ import annotations

import torch
from torch import Tensor

GRADIENT = "gradient"  # counted where every term was finite and the gradient was not


class SkippedSteps:
    """Steps skipped because a term or a gradient was not finite.

    Attributes:
        count: skipped steps, int64.
        iteration: index of the last skipped step, int64; -1 for none.
        terms: for each term, the number of skipped steps in which it was not finite, int64.
        window: inputs of the last skipped step, by name.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.count = torch.zeros((), dtype=torch.int64, device=device)
        self.iteration = torch.full((), -1, dtype=torch.int64, device=device)
        self.terms: dict[str, Tensor] = {}
        self.window: dict[str, Tensor] = {}

    def record(self, bad: Tensor, iteration: Tensor, terms: dict[str, Tensor], window: dict[str, Tensor]) -> None:
        """Record one step without branching; `bad`, a flag on the device, says whether it was skipped."""
        broken = {name: bad & ~value.isfinite() for name, value in terms.items()}
        broken[GRADIENT] = bad & ~torch.stack([*broken.values()]).any()
        for name, flag in broken.items():
            self.terms.setdefault(name, torch.zeros_like(self.count)).add_(flag)
        for name, value in window.items():
            kept = self.window.setdefault(name, torch.zeros_like(value))
            kept.copy_(torch.where(bad, value, kept))
        self.iteration.copy_(torch.where(bad, iteration, self.iteration))
        self.count.add_(bad)
