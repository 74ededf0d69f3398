# SPDX-License-Identifier: Apache-2.0
"""How the latent state advances: the paper's Eqs. 3, 11 and 12 behind one call."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from .. import kernels
from ..config import DISTANCE_SCALE, MOST_GIVEN, OWN_SHARE, RATE_SHARE, REACH, VELOCITY_SCALE, ModelConfig

SMALLEST = 1e-12  # far below any length that counts; its square's inverse is finite in float32


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


def length(vectors: Tensor) -> Tensor:
    """Return the Euclidean length of each row, shape (batch, 1)."""
    return torch.linalg.vector_norm(vectors, dim=1, keepdim=True)


def shortened(vectors: Tensor, longest: Tensor) -> Tensor:
    """Return rows (batch, n) no longer than (batch, 1), with their directions."""
    return vectors * (longest / length(vectors).clamp_min(SMALLEST)).clamp(max=1)


class Integrator(nn.Module, ABC):
    """Advances z from two past states.

    With `config.latent_bound` each new state is limited, so that it can never leave the range where the decoder was
    trained, however long the rollout.

    Args:
        config: bounds and sizes.
        rates: how many of the last entries of a dynamic descriptor are zero while the character holds still.

    Attributes:
        states: latent vectors that the stepper S sees beside the pose.
        centred: whether only differences of what S gives are used, so that a bias of its last layer would do nothing.
    """

    states = 2
    centred = False

    def __init__(self, config: ModelConfig, rates: int = 0) -> None:
        super().__init__()
        self.config, self.rates = config, rates

    def forward(self, stepper: nn.Module, before: Tensor, now: Tensor, rest: Tensor, pose: Tensor) -> Tensor:
        """Return z_t, shape (batch, latent).

        Args:
            stepper: the network S, from (batch, states * latent + pose) to (batch, latent).
            before, now: z_{t-2} and z_{t-1}.
            rest: the quasi-static state P(theta_t) of the pose at t.
            pose: dynamic descriptor at t.
        """
        return self.follow(stepper, before, now, self.known(stepper, rest, pose))

    def known(self, stepper: nn.Module, rest: Tensor, pose: Tensor) -> tuple[Tensor, ...]:
        """Return what steps need that no state decides, rows of any number of frames at once."""
        return rest, pose

    def follow(self, stepper: nn.Module, before: Tensor, now: Tensor, known: Sequence[Tensor]) -> Tensor:
        """Return z_t, shape (batch, latent), from the two states before and what is `known` of the frame."""
        return self.bounded(self.advance(stepper, before, now, *known))

    def bounded(self, z: Tensor) -> Tensor:
        """Return states within their bound."""
        return limited(z, self.config.latent_bound)

    @abstractmethod
    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, *known: Tensor) -> Tensor: ...


class Verlet(Integrator):
    """z_t = zbar + S([zbar, z_{t-1}, pose]) with zbar = alpha z_{t-1} + beta (z_{t-1} - z_{t-2}) (Eqs. 2, 3).

    With `config.max_latent_step` what S adds in a step, a latent acceleration, is limited: the state cannot be flung.
    """

    def __init__(self, config: ModelConfig, rates: int = 0) -> None:
        super().__init__(config, rates)
        self.alpha = nn.Parameter(torch.full((config.latent,), 1.0))
        # 1 would turn noise on the first two states into a steady drift; 0.9 lets it die within a second.
        self.beta = nn.Parameter(torch.full((config.latent,), 0.9))

    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, *known: Tensor) -> Tensor:
        _, pose = known
        forward = self.alpha * now + self.beta * (now - before)
        return forward + limited(stepper(torch.cat([forward, now, pose], dim=1)), self.config.max_latent_step)


class SpringVerlet(Integrator):
    """Eqs. 2 and 3 about the quasi-static state p = P(theta_t), with a spring towards it.

        zbar = z_{t-1} + beta v,    v = z_{t-1} - z_{t-2},    f = k (p - zbar)
        z_t = zbar + f + u,         u = s (S(z_{t-1}, v, p - zbar, pose) - S(p, 0, 0, pose held still))

    Without S every dimension is a damped spring, stable for any k in (0, 1]; S learns what such a spring misses.
    What S would do to a garment at rest under a character that holds still is taken off, so that the garment rests
    at p exactly: where gravity alone pulls, an error of a millimetre a frame is a tenth of gravity, and no loss
    that also holds stretch and collisions can see it. Stiffnesses start spread from slow swings to quick following
    and stay under `config.stiffness`; spring and S together are limited by `config.max_latent_step`.

    And it rests nowhere else, whatever S has learnt: S may give half of what the spring gives, and more only
    while something moves,

        |u| <= (|f| + |v|) / 2 + |rates of the pose| / 20,

    which motion seldom comes near. Eq. 2's alpha is one: a larger one would undo the spring.

    S sees velocities and distances themselves, scaled to order one: given as states side by side they would be
    small differences of large inputs, and those are learnt last. `reach` s scales S to what it has to give.
    """

    states = 3
    centred = True
    slowest = 0.01
    velocity_scale, distance_scale, reach = VELOCITY_SCALE, DISTANCE_SCALE, REACH
    most, own_share, rate_share = MOST_GIVEN, OWN_SHARE, RATE_SHARE

    def __init__(self, config: ModelConfig, rates: int = 0) -> None:
        super().__init__(config, rates)
        slowest = min(self.slowest, 0.05 * config.stiffness)
        start = torch.logspace(math.log10(slowest), math.log10(0.9 * config.stiffness), config.latent)
        # S learns what this damps too much; what it damps too little would excite itself.
        self.beta = nn.Parameter(torch.full((config.latent,), 0.7))
        self.share = nn.Parameter(torch.logit(start / config.stiffness))

    def known(self, stepper: nn.Module, rest: Tensor, pose: Tensor) -> tuple[Tensor, ...]:
        """Return the quasi-static state, the pose, what S would do to a garment at rest there, and |rates| / 20."""
        static, rates = pose.tensor_split([pose.shape[1] - self.rates], dim=1)
        nothing = torch.zeros_like(rest)
        held = self._of(stepper, rest, nothing, nothing, static, torch.zeros_like(rates))
        return rest, pose, held, self.rate_share * length(rates)

    def follow(self, stepper: nn.Module, before: Tensor, now: Tensor, known: Sequence[Tensor]) -> Tensor:
        if torch.is_grad_enabled() or torch.compiler.is_compiling() or not kernels.serve(now):
            return super().follow(stepper, before, now, known)
        from ..kernels.spring import next_kernel, seen_kernel

        rest, pose, held, roused = known
        moved = stepper(seen_kernel(before, now, rest, pose, self.beta, (self.velocity_scale, self.distance_scale)))
        stiffness, push, bound = self.config.stiffness, self.config.max_latent_step, self.config.latent_bound
        limits = stiffness, self.most, self.reach, self.own_share, push, bound
        return next_kernel((before, now), rest, (moved, held), roused, (self.beta, self.share), limits)

    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, *known: Tensor) -> Tensor:
        rest, pose, held, roused = known
        velocity = now - before
        forward = now + self.beta * velocity
        away = rest - forward
        moved = self._of(stepper, now, self.velocity_scale * velocity, self.distance_scale * away, pose)
        spring = self.config.stiffness * torch.sigmoid(self.share) * away
        allowed = self.own_share * (length(spring) + length(velocity)) + roused
        return forward + limited(
            spring + shortened(self.reach * (moved - held), allowed), self.config.max_latent_step
        )

    def _of(self, stepper: nn.Module, *seen: Tensor) -> Tensor:
        return stepper(torch.cat(seen, dim=1)).clamp(-self.most, self.most)


class Direct(Integrator):
    """z_t = S([z_{t-2}, z_{t-1}, pose]) (Eq. 11)."""

    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, *known: Tensor) -> Tensor:
        return stepper(torch.cat([before, now, known[1]], dim=1))


class DirectResidual(Integrator):
    """z_t = z_{t-1} + S([z_{t-2}, z_{t-1}, pose]) (Eq. 12)."""

    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, *known: Tensor) -> Tensor:
        return now + stepper(torch.cat([before, now, known[1]], dim=1))


class QuasiStatic(Integrator):
    """z_t = P(theta_t): no stepper and no past, for garments with nothing loose, which P alone dresses as well."""

    states = 0

    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, *known: Tensor) -> Tensor:
        return known[0]

    def follow(self, stepper: nn.Module, before: Tensor, now: Tensor, known: Sequence[Tensor]) -> Tensor:
        return self.advance(stepper, before, now, *known)  # within its bound already


INTEGRATORS: dict[str, type[Integrator]] = {
    "spring_verlet": SpringVerlet,
    "verlet": Verlet,
    "direct": Direct,
    "direct_residual": DirectResidual,
    "quasi_static": QuasiStatic,
}
