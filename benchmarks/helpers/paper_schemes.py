# SPDX-License-Identifier: Apache-2.0
"""The integration schemes that the paper's Figure 11 compares with its own: Eqs. 11 and 12.

In each, S may see the cloth (Figure 2). 'ssilk' has only the paper's own, "verlet". A script that trains, loads or
measures such models calls `register` first.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ssilk_core.network.model.integrators import Integrator
from ssilk_core.network.schemes import SCHEMES, Scheme


class Direct(Integrator):
    """z_t = S([z_{t-2}, z_{t-1}, pose, cloth]) (Eq. 11)."""

    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, seen: Tensor, *precomputed: Tensor) -> Tensor:
        return stepper(torch.cat([before, now, precomputed[1], seen], dim=1))


class DirectResidual(Integrator):
    """z_t = z_{t-1} + S([z_{t-2}, z_{t-1}, pose, cloth]) (Eq. 12)."""

    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, seen: Tensor, *precomputed: Tensor) -> Tensor:
        return now + stepper(torch.cat([before, now, precomputed[1], seen], dim=1))


PAPER_SCHEMES = {
    "direct": Scheme(integrator=f"{__name__}:Direct", states=2),
    "direct_residual": Scheme(integrator=f"{__name__}:DirectResidual", states=2),
}


def register() -> None:
    """Let settings and model files name these schemes."""
    SCHEMES.update(PAPER_SCHEMES)
