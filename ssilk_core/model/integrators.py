# SPDX-License-Identifier: Apache-2.0
"""How the latent state advances: the paper's Eqs. 3, 11 and 12 behind one call."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from ..config import ModelConfig


def limited(values: Tensor, bound: float) -> Tensor:
    """Return b tanh(values / b), the identity around zero; unlimited for a bound of zero."""
    return bound * torch.tanh(values / bound) if bound else values


class Integrator(nn.Module, ABC):
    """Advances z from two past states.

    With `config.bound` each new state is limited, so that it can never leave the range where the decoder was
    trained, however long the rollout.

    Attributes:
        states: latent vectors that the stepper S sees beside the pose.
    """

    states = 2

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config

    def forward(self, stepper: nn.Module, before: Tensor, now: Tensor, rest: Tensor, pose: Tensor) -> Tensor:
        """Return z_t, shape (batch, latent).

        Args:
            stepper: the network S, from (batch, states * latent + pose) to (batch, latent).
            before, now: z_{t-2} and z_{t-1}.
            rest: the quasi-static state P(theta_t) of the pose at t.
            pose: dynamic descriptor at t.
        """
        return self.bounded(self.advance(stepper, before, now, rest, pose))

    def bounded(self, z: Tensor) -> Tensor:
        """Return states within their bound."""
        return limited(z, self.config.bound)

    @abstractmethod
    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, rest: Tensor, pose: Tensor) -> Tensor: ...


class Verlet(Integrator):
    """z_t = zbar + S([zbar, z_{t-1}, pose]) with zbar = alpha z_{t-1} + beta (z_{t-1} - z_{t-2}) (Eqs. 2, 3).

    With `config.push` what S adds in a step, a latent acceleration, is limited: the state cannot be flung.
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__(config)
        self.alpha = nn.Parameter(torch.full((config.latent,), 1.0))
        # 1 would turn noise on the first two states into a steady drift; 0.9 lets it die within a second.
        self.beta = nn.Parameter(torch.full((config.latent,), 0.9))

    def extrapolated(self, before: Tensor, now: Tensor) -> Tensor:
        return self.alpha * now + self.beta * (now - before)

    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, rest: Tensor, pose: Tensor) -> Tensor:
        forward = self.extrapolated(before, now)
        return forward + limited(stepper(torch.cat([forward, now, pose], dim=1)), self.config.push)


class SpringVerlet(Verlet):
    """Eq. 3 with a spring: z_t = zbar + k (P(theta_t) - zbar) + S([zbar, z_{t-1}, P(theta_t), pose]).

    Without S every dimension is a damped spring towards the quasi-static state, stable for any k in (0, 1]; S
    learns what such a spring misses. Stiffnesses start spread from slow swings to quick following and stay under
    `config.stiffness`; spring and S together are limited by `config.push`.
    """

    states = 3
    slowest = 0.01

    def __init__(self, config: ModelConfig) -> None:
        super().__init__(config)
        slowest = min(self.slowest, 0.05 * config.stiffness)
        start = torch.logspace(math.log10(slowest), math.log10(0.9 * config.stiffness), config.latent)
        self.share = nn.Parameter(torch.logit(start / config.stiffness))

    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, rest: Tensor, pose: Tensor) -> Tensor:
        forward = self.extrapolated(before, now)
        pull = self.config.stiffness * torch.sigmoid(self.share) * (rest - forward)
        return forward + limited(pull + stepper(torch.cat([forward, now, rest, pose], dim=1)), self.config.push)


class Direct(Integrator):
    """z_t = S([z_{t-2}, z_{t-1}, pose]) (Eq. 11)."""

    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, rest: Tensor, pose: Tensor) -> Tensor:
        return stepper(torch.cat([before, now, pose], dim=1))


class DirectResidual(Integrator):
    """z_t = z_{t-1} + S([z_{t-2}, z_{t-1}, pose]) (Eq. 12)."""

    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, rest: Tensor, pose: Tensor) -> Tensor:
        return now + stepper(torch.cat([before, now, pose], dim=1))


INTEGRATORS: dict[str, type[Integrator]] = {
    "spring_verlet": SpringVerlet,
    "verlet": Verlet,
    "direct": Direct,
    "direct_residual": DirectResidual,
}
