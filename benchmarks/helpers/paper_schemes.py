# SPDX-License-Identifier: Apache-2.0
"""The paper's integration schemes, which its Figure 11 compares: Eqs. 3, 11 and 12.

In each, S may see the cloth (Figure 2). 'ssilk' has none of them. A script that trains, loads or measures such models
calls `register` first.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ssilk_core.network.model.integrators import Integrator, soft_clamp
from ssilk_core.network.schemes import SCHEMES, Scheme
from ssilk_core.network.settings import ModelConfig


class Verlet(Integrator):
    """z_t = zbar + S([zbar, z_{t-1}, pose, cloth]) with zbar = alpha z_{t-1} + beta (z_{t-1} - z_{t-2}) (Eqs. 2, 3).

    `config.max_latent_step` limits what S adds in a step.
    """

    def __init__(self, config: ModelConfig, rates: int = 0) -> None:
        super().__init__(config, rates)
        self.alpha = nn.Parameter(torch.full((config.latent,), 1.0))
        # 1 would turn noise on the first two states into a steady drift; with 0.9 it decays within a second.
        self.beta = nn.Parameter(torch.full((config.latent,), 0.9))

    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, seen: Tensor, *precomputed: Tensor) -> Tensor:
        _, pose = precomputed
        forward = self.alpha * now + self.beta * (now - before)
        added = stepper(torch.cat([forward, now, pose, seen], dim=1))
        return forward + soft_clamp(added, self.config.max_latent_step)


class Direct(Integrator):
    """z_t = S([z_{t-2}, z_{t-1}, pose, cloth]) (Eq. 11)."""

    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, seen: Tensor, *precomputed: Tensor) -> Tensor:
        return stepper(torch.cat([before, now, precomputed[1], seen], dim=1))


class DirectResidual(Integrator):
    """z_t = z_{t-1} + S([z_{t-2}, z_{t-1}, pose, cloth]) (Eq. 12)."""

    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, seen: Tensor, *precomputed: Tensor) -> Tensor:
        return now + stepper(torch.cat([before, now, precomputed[1], seen], dim=1))


PAPER_SCHEMES = {
    "verlet": Scheme(integrator=f"{__name__}:Verlet", states=2, parameters=("alpha", "beta")),
    "direct": Scheme(integrator=f"{__name__}:Direct", states=2),
    "direct_residual": Scheme(integrator=f"{__name__}:DirectResidual", states=2),
}


def register() -> None:
    """Let settings and model files name the paper's schemes."""
    SCHEMES.update(PAPER_SCHEMES)
