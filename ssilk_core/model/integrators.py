# SPDX-License-Identifier: Apache-2.0
"""Integration schemes of the latent state: the paper's Eqs. 3, 11 and 12, and a damped spring."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from .. import kernels
from ..config import (
    DISTANCE_SCALE,
    FORCE_ALLOWANCE,
    MAX_STEPPER_OUTPUT,
    RATE_ALLOWANCE,
    STEPPER_OUTPUT_SCALE,
    VELOCITY_SCALE,
    ModelConfig,
)

NORM_EPSILON = 1e-12  # far below any length that counts; its square's inverse is finite in float32


def soft_clamp(values: Tensor, bound: float) -> Tensor:
    """Clamp values smoothly to a bound b; a bound of zero changes nothing.

    The clamp is the identity up to h = b / 2, so that it does not damp states well within the bound. Beyond, it is
    h + h tanh((|v| - h) / h), which never exceeds b.
    """
    if not bound:
        return values
    half = bound / 2
    inner = values.clamp(-half, half)
    return inner + half * torch.tanh((values - inner) / half)


def length(vectors: Tensor) -> Tensor:
    """Return the Euclidean length of each row, shape (batch, 1)."""
    return torch.linalg.vector_norm(vectors, dim=1, keepdim=True)


def clip_norm(vectors: Tensor, longest: Tensor) -> Tensor:
    """Clip the norm of each row (batch, n) to `longest` (batch, 1); directions stay."""
    return vectors * (longest / length(vectors).clamp_min(NORM_EPSILON)).clamp(max=1)


class Integrator(nn.Module, ABC):
    """Advances z from the two states before it.

    `config.latent_bound` clamps each new state, so that it stays in the range that the decoder was trained on,
    however long the rollout.

    Args:
        config: bounds and sizes.
        rates: number of last entries of a dynamic descriptor that are zero while the character holds still.

    Attributes:
        states: latent vectors among the inputs of the stepper S.
        centred: whether only differences between outputs of S are used; its last layer then needs no bias.
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
        return self.step(stepper, before, now, self.precompute(stepper, rest, pose))

    def precompute(self, stepper: nn.Module, rest: Tensor, pose: Tensor) -> tuple[Tensor, ...]:
        """Return the inputs of `step` that depend on no state, for any number of frames at once."""
        return rest, pose

    def step(self, stepper: nn.Module, before: Tensor, now: Tensor, precomputed: Sequence[Tensor]) -> Tensor:
        """Return z_t, shape (batch, latent), from the two states before it and the `precompute`d values."""
        return self.bound(self.advance(stepper, before, now, *precomputed))

    def bound(self, z: Tensor) -> Tensor:
        """Clamp states to `config.latent_bound`."""
        return soft_clamp(z, self.config.latent_bound)

    @abstractmethod
    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, *precomputed: Tensor) -> Tensor: ...


class Verlet(Integrator):
    """z_t = zbar + S([zbar, z_{t-1}, pose]) with zbar = alpha z_{t-1} + beta (z_{t-1} - z_{t-2}) (Eqs. 2, 3).

    `config.max_latent_step` clamps the output of S, a latent acceleration.
    """

    def __init__(self, config: ModelConfig, rates: int = 0) -> None:
        super().__init__(config, rates)
        self.alpha = nn.Parameter(torch.full((config.latent,), 1.0))
        # 1 would turn noise on the first two states into a steady drift; with 0.9 it decays within a second.
        self.beta = nn.Parameter(torch.full((config.latent,), 0.9))

    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, *precomputed: Tensor) -> Tensor:
        _, pose = precomputed
        forward = self.alpha * now + self.beta * (now - before)
        return forward + soft_clamp(stepper(torch.cat([forward, now, pose], dim=1)), self.config.max_latent_step)


class SpringVerlet(Integrator):
    """Eqs. 2 and 3 about the quasi-static state p = P(theta_t), with a spring towards it.

        zbar = z_{t-1} + beta v,    v = z_{t-1} - z_{t-2},    f = k (p - zbar)
        z_t = zbar + f + u,         u = s (S(z_{t-1}, v, p - zbar, pose) - S(p, 0, 0, pose held still))

    Without S every dimension is a damped spring, stable for any k in (0, 1]. S learns what such a spring misses.
    Spring constants start spread over slow and fast springs and stay below `config.stiffness`.
    `config.max_latent_step` clamps f + u.

    The output of S for a garment at rest, under a character that holds still, is subtracted, so that the garment
    rests at p exactly. The training loss could not ensure that: an error of one millimetre a frame is a tenth of
    gravity, which stretch and collisions outweigh.

    The garment rests nowhere else, whatever S has learned. S may add half of what the spring does, and more only
    while something moves; motion seldom comes near this limit:

        |u| <= (|f| + |v|) / 2 + |rates of the pose| / 20

    Eq. 2's alpha is one: a larger one would cancel the spring.

    The inputs of S are velocities and distances, scaled to order one. The states themselves would make these small
    differences of large inputs, which a network learns last. s = `STEPPER_OUTPUT_SCALE` scales the output of S.
    """

    states = 3
    centred = True
    slowest = 0.01

    def __init__(self, config: ModelConfig, rates: int = 0) -> None:
        super().__init__(config, rates)
        slowest = min(self.slowest, 0.05 * config.stiffness)
        start = torch.logspace(math.log10(slowest), math.log10(0.9 * config.stiffness), config.latent)
        # S can learn to make up for too much damping; too little would let oscillations grow.
        self.beta = nn.Parameter(torch.full((config.latent,), 0.7))
        self.share = nn.Parameter(torch.logit(start / config.stiffness))

    def precompute(self, stepper: nn.Module, rest: Tensor, pose: Tensor) -> tuple[Tensor, ...]:
        """Return the quasi-static state, the pose, the output of S at rest in this pose, and |rates| / 20."""
        static, rates = pose.tensor_split([pose.shape[1] - self.rates], dim=1)
        zero = torch.zeros_like(rest)
        output_at_rest = self._evaluate(stepper, rest, zero, zero, static, torch.zeros_like(rates))
        return rest, pose, output_at_rest, RATE_ALLOWANCE * length(rates)

    def step(self, stepper: nn.Module, before: Tensor, now: Tensor, precomputed: Sequence[Tensor]) -> Tensor:
        if torch.is_grad_enabled() or torch.compiler.is_compiling() or not kernels.supports(now):
            return super().step(stepper, before, now, precomputed)
        from ..kernels.spring import next_state_kernel, stepper_input_kernel

        rest, pose, output_at_rest, rate_allowance = precomputed
        scales = VELOCITY_SCALE, DISTANCE_SCALE
        output = stepper(stepper_input_kernel(before, now, rest, pose, self.beta, scales))
        stiffness, max_step, bound = self.config.stiffness, self.config.max_latent_step, self.config.latent_bound
        limits = stiffness, MAX_STEPPER_OUTPUT, STEPPER_OUTPUT_SCALE, FORCE_ALLOWANCE, max_step, bound
        outputs, springs = (output, output_at_rest), (self.beta, self.share)
        return next_state_kernel((before, now), rest, outputs, rate_allowance, springs, limits)

    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, *precomputed: Tensor) -> Tensor:
        rest, pose, output_at_rest, rate_allowance = precomputed
        velocity = now - before
        forward = now + self.beta * velocity
        away = rest - forward
        output = self._evaluate(stepper, now, VELOCITY_SCALE * velocity, DISTANCE_SCALE * away, pose)
        spring = self.config.stiffness * torch.sigmoid(self.share) * away
        allowance = FORCE_ALLOWANCE * (length(spring) + length(velocity)) + rate_allowance
        learned = clip_norm(STEPPER_OUTPUT_SCALE * (output - output_at_rest), allowance)
        return forward + soft_clamp(spring + learned, self.config.max_latent_step)

    def _evaluate(self, stepper: nn.Module, *inputs: Tensor) -> Tensor:
        return stepper(torch.cat(inputs, dim=1)).clamp(-MAX_STEPPER_OUTPUT, MAX_STEPPER_OUTPUT)


class Direct(Integrator):
    """z_t = S([z_{t-2}, z_{t-1}, pose]) (Eq. 11)."""

    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, *precomputed: Tensor) -> Tensor:
        return stepper(torch.cat([before, now, precomputed[1]], dim=1))


class DirectResidual(Integrator):
    """z_t = z_{t-1} + S([z_{t-2}, z_{t-1}, pose]) (Eq. 12)."""

    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, *precomputed: Tensor) -> Tensor:
        return now + stepper(torch.cat([before, now, precomputed[1]], dim=1))


class QuasiStatic(Integrator):
    """z_t = P(theta_t): no stepper and no earlier states, for garments without loose vertices."""

    states = 0

    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, *precomputed: Tensor) -> Tensor:
        return precomputed[0]

    def step(self, stepper: nn.Module, before: Tensor, now: Tensor, precomputed: Sequence[Tensor]) -> Tensor:
        return self.advance(stepper, before, now, *precomputed)  # `rest` is already clamped


INTEGRATORS: dict[str, type[Integrator]] = {
    "spring_verlet": SpringVerlet,
    "verlet": Verlet,
    "direct": Direct,
    "direct_residual": DirectResidual,
    "quasi_static": QuasiStatic,
}
