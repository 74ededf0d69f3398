# SPDX-License-Identifier: Apache-2.0
"""How the latent state advances: the paper's Eqs. 3, 11 and 12 behind one call."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn

from ..config import ModelConfig


def limited(values: Tensor, bound: float) -> Tensor:
    """Return values kept within a bound b; unlimited for a bound of zero.

    The identity up to b / 2, so that a state well within its bound is not drawn towards zero step by step; from
    there it bends smoothly, h + h tanh((|v| - h) / h) with h = b / 2, and never passes b.
    """
    if not bound:
        return values
    half = bound / 2
    inner = values.clamp(-half, half)
    return inner + half * torch.tanh((values - inner) / half)


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
    """Eq. 3 with a spring: z_t = zbar + k (P(theta_t) - zbar) + s S([z_{t-1}, v, d, pose]).

    S sees the state, its velocity v = z_{t-1} - z_{t-2} and its distance d = P(theta_t) - zbar from rest, each
    scaled to order one: given as states side by side, velocities would be small differences of large inputs, and
    those are learnt last. `reach` s scales what S gives to what it has to give.

    Without S every dimension is a damped spring towards the quasi-static state, stable for any k in (0, 1]; S
    learns what such a spring misses. Stiffnesses start spread from slow swings to quick following and stay under
    `config.stiffness`; spring and S together are limited by `config.push`.
    """

    states = 3
    slowest = 0.01
    velocity_scale, distance_scale, reach = 10.0, 3.0, 0.1

    def __init__(self, config: ModelConfig) -> None:
        super().__init__(config)
        slowest = min(self.slowest, 0.05 * config.stiffness)
        start = torch.logspace(math.log10(slowest), math.log10(0.9 * config.stiffness), config.latent)
        self.share = nn.Parameter(torch.logit(start / config.stiffness))

    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, rest: Tensor, pose: Tensor) -> Tensor:
        forward = self.extrapolated(before, now)
        away = rest - forward
        seen = [now, self.velocity_scale * (now - before), self.distance_scale * away, pose]
        pull = self.config.stiffness * torch.sigmoid(self.share) * away
        return forward + limited(pull + self.reach * stepper(torch.cat(seen, dim=1)), self.config.push)


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
