# SPDX-License-Identifier: Apache-2.0
"""How the latent state advances: the paper's Eqs. 3, 11 and 12 behind one call."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import torch
from torch import Tensor, nn


class Integrator(nn.Module, ABC):
    """Advances z from two past states.

    With a bound b > 0 each new state is b tanh(z / b): the state can never leave [-b, b], so a rollout of any
    length stays where the decoder was trained. Around zero the map is the identity.

    Attributes:
        states: latent vectors that the stepper S sees beside the pose.
    """

    states = 2

    def __init__(self, latent: int, bound: float) -> None:
        super().__init__()
        self.bound = bound

    def forward(self, stepper: nn.Module, before: Tensor, now: Tensor, rest: Tensor, pose: Tensor) -> Tensor:
        """Return z_t, shape (batch, latent).

        Args:
            stepper: the network S, from (batch, states * latent + pose) to (batch, latent).
            before, now: z_{t-2} and z_{t-1}.
            rest: the quasi-static state P(theta_t) of the pose at t.
            pose: dynamic descriptor at t.
        """
        return self.limited(self.advance(stepper, before, now, rest, pose))

    def limited(self, z: Tensor) -> Tensor:
        """Return the state within its bound."""
        return self.bound * torch.tanh(z / self.bound) if self.bound else z

    @abstractmethod
    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, rest: Tensor, pose: Tensor) -> Tensor: ...


class Verlet(Integrator):
    """z_t = zbar + S([zbar, z_{t-1}, pose]) with zbar = alpha z_{t-1} + beta (z_{t-1} - z_{t-2}) (Eqs. 2, 3)."""

    def __init__(self, latent: int, bound: float) -> None:
        super().__init__(latent, bound)
        self.alpha = nn.Parameter(torch.full((latent,), 1.0))
        # 1 would turn noise on the first two states into a steady drift; 0.9 lets it die within a second.
        self.beta = nn.Parameter(torch.full((latent,), 0.9))

    def extrapolated(self, before: Tensor, now: Tensor) -> Tensor:
        return self.alpha * now + self.beta * (now - before)

    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, rest: Tensor, pose: Tensor) -> Tensor:
        forward = self.extrapolated(before, now)
        return forward + stepper(torch.cat([forward, now, pose], dim=1))


class SpringVerlet(Verlet):
    """Eq. 3 with a spring: z_t = zbar + k (P(theta_t) - zbar) + S([zbar, z_{t-1}, P(theta_t), pose]).

    Without S every dimension is a damped spring towards the quasi-static state, stable for any k in (0, 1]; S learns what
    such a spring misses. Stiffnesses start spread from slow swings to immediate following.
    """

    states = 3
    slowest, fastest = 0.02, 0.95

    def __init__(self, latent: int, bound: float) -> None:
        super().__init__(latent, bound)
        start = torch.logspace(math.log10(self.slowest), math.log10(self.fastest), latent)
        self.stiffness = nn.Parameter(torch.logit(start))

    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, rest: Tensor, pose: Tensor) -> Tensor:
        forward = self.extrapolated(before, now)
        pulled = torch.lerp(forward, rest, torch.sigmoid(self.stiffness))
        return pulled + stepper(torch.cat([pulled, now, rest, pose], dim=1))


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
