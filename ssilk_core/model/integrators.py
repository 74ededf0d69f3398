# SPDX-License-Identifier: Apache-2.0
"""How the latent state advances: the integrators of the schemes in `ssilk_core.schemes`."""

from __future__ import annotations

import importlib
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from .. import kernels
from ..config import (
    DISTANCE_SCALE,
    MAX_OUTPUT,
    OUTPUT_SCALE,
    RATE_ALLOWANCE,
    STATE_ALLOWANCE,
    VELOCITY_SCALE,
    ModelConfig,
)
from ..schemes import SCHEMES

SMALLEST = 1e-12  # far below any length that counts; its square's inverse is finite in float32


def limited(values: Tensor, bound: float) -> Tensor:
    """Return values kept within a bound b; unlimited for a bound of zero.

    The identity up to h = b / 2, so that steps do not draw a state well within its bound towards zero. Beyond, it is
    h + h tanh((|v| - h) / h), which is smooth and never passes b.
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

    `config.latent_bound` limits each new state, so that no rollout leaves the range that the decoder was trained on.

    Args:
        config: bounds and sizes.
        rates: how many of the last entries of a dynamic descriptor are zero while the character holds still.

    Attributes:
        scheme: its entry in `schemes.SCHEMES`.
    """

    def __init__(self, config: ModelConfig, rates: int = 0) -> None:
        super().__init__()
        self.config, self.rates, self.scheme = config, rates, SCHEMES[config.scheme]

    def forward(self, stepper: nn.Module, before: Tensor, now: Tensor, rest: Tensor, pose: Tensor) -> Tensor:
        """Return z_t, shape (batch, latent).

        Args:
            stepper: the network S, from (batch, states * latent + pose) to (batch, latent).
            before, now: z_{t-2} and z_{t-1}.
            rest: the quasi-static state P(theta_t) of the pose at t.
            pose: dynamic descriptor at t.
        """
        return self.follow(stepper, before, now, self.precomputed(stepper, rest, pose))

    def precomputed(self, stepper: nn.Module, rest: Tensor, pose: Tensor) -> tuple[Tensor, ...]:
        """Return what steps need and no past state decides, rows of any number of frames at once."""
        return rest, pose

    def follow(self, stepper: nn.Module, before: Tensor, now: Tensor, precomputed: Sequence[Tensor]) -> Tensor:
        """Return z_t, shape (batch, latent), from the two states before and a frame's rows of `precomputed`."""
        return self.bounded(self.advance(stepper, before, now, *precomputed))

    def bounded(self, z: Tensor) -> Tensor:
        """Return states within their bound."""
        return limited(z, self.config.latent_bound)

    @abstractmethod
    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, *precomputed: Tensor) -> Tensor:
        """Return z_t before it is limited, shape (batch, latent)."""


class SpringVerlet(Integrator):
    """Eqs. 2 and 3 about the quasi-static state p = P(theta_t), with a spring towards it.

        zbar = z_{t-1} + beta v,    v = z_{t-1} - z_{t-2},    f = k (p - zbar)
        z_t = zbar + f + u,         u = s (S(z_{t-1}, v, p - zbar, pose) - S(p, 0, 0, pose held still))

    Without S every dimension is a damped spring, stable for any k in (0, 1]. S learns what such a spring misses.
    The output of S for a garment at rest under a still character is subtracted, so that p is an equilibrium. The
    loss cannot enforce this: an error of a millimetre a frame is a tenth of gravity, and stretch and collisions
    hide it. Stiffnesses start spread from slow swings to quick following and stay under `config.stiffness`.
    `config.max_latent_step` limits spring and S together.

    p is the only equilibrium, whatever S has learnt, because S gives at most half of what the spring gives, and
    more only while something moves:

        |u| <= (|f| + |v|) / 2 + |rates of the pose| / 20

    Motion seldom reaches this limit. Eq. 2's alpha is one: a larger one would undo the spring.

    S sees velocities and distances, scaled to order one. Given as states side by side they would be small
    differences of large inputs, which networks learn last. `output_scale` is s.
    """

    slowest = 0.01
    velocity_scale, distance_scale, output_scale = VELOCITY_SCALE, DISTANCE_SCALE, OUTPUT_SCALE
    max_output, state_allowance, rate_allowance = MAX_OUTPUT, STATE_ALLOWANCE, RATE_ALLOWANCE

    def __init__(self, config: ModelConfig, rates: int = 0) -> None:
        super().__init__(config, rates)
        slowest = min(self.slowest, 0.05 * config.stiffness)
        start = torch.logspace(math.log10(slowest), math.log10(0.9 * config.stiffness), config.latent)
        # S learns what this damps too much; what it damps too little would excite itself.
        self.beta = nn.Parameter(torch.full((config.latent,), 0.7))
        self.share = nn.Parameter(torch.logit(start / config.stiffness))

    def precomputed(self, stepper: nn.Module, rest: Tensor, pose: Tensor) -> tuple[Tensor, ...]:
        """Return the quasi-static state, the pose, the output of S at rest there, and |rates| / 20."""
        static, rates = pose.tensor_split([pose.shape[1] - self.rates], dim=1)
        nothing = torch.zeros_like(rest)
        at_rest = self._of(stepper, rest, nothing, nothing, static, torch.zeros_like(rates))
        return rest, pose, at_rest, self.rate_allowance * length(rates)

    def follow(self, stepper: nn.Module, before: Tensor, now: Tensor, precomputed: Sequence[Tensor]) -> Tensor:
        if torch.is_grad_enabled() or torch.compiler.is_compiling() or not kernels.serve(now):
            return super().follow(stepper, before, now, precomputed)
        from ..kernels.spring import next_kernel, seen_kernel

        rest, pose, at_rest, rate_allowance = precomputed
        moved = stepper(seen_kernel(before, now, rest, pose, self.beta, (self.velocity_scale, self.distance_scale)))
        stiffness, max_step, bound = self.config.stiffness, self.config.max_latent_step, self.config.latent_bound
        limits = stiffness, self.max_output, self.output_scale, self.state_allowance, max_step, bound
        return next_kernel((before, now), rest, (moved, at_rest), rate_allowance, (self.beta, self.share), limits)

    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, *precomputed: Tensor) -> Tensor:
        rest, pose, at_rest, rate_allowance = precomputed
        velocity = now - before
        forward = now + self.beta * velocity
        away = rest - forward
        moved = self._of(stepper, now, self.velocity_scale * velocity, self.distance_scale * away, pose)
        spring = self.config.stiffness * torch.sigmoid(self.share) * away
        allowed = self.state_allowance * (length(spring) + length(velocity)) + rate_allowance
        return forward + limited(
            spring + shortened(self.output_scale * (moved - at_rest), allowed), self.config.max_latent_step
        )

    def _of(self, stepper: nn.Module, *seen: Tensor) -> Tensor:
        return stepper(torch.cat(seen, dim=1)).clamp(-self.max_output, self.max_output)


class QuasiStatic(Integrator):
    """z_t = P(theta_t), with no stepper and no past, for garments without loose parts."""

    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, *precomputed: Tensor) -> Tensor:
        return precomputed[0]

    def follow(self, stepper: nn.Module, before: Tensor, now: Tensor, precomputed: Sequence[Tensor]) -> Tensor:
        return self.advance(stepper, before, now, *precomputed)  # within its bound already


def integrator(config: ModelConfig, rates: int = 0) -> Integrator:
    """Return the integrator of a network's scheme; `rates` as in `Integrator`."""
    module, _, name = SCHEMES[config.scheme].integrator.partition(":")
    return getattr(importlib.import_module(module), name)(config, rates)
