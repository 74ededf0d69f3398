# SPDX-License-Identifier: Apache-2.0
"""How the latent state advances: the integrators of the schemes in `ssilk_core.network.schemes`."""

from __future__ import annotations

import importlib
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ...physics import kernels
from ..schemes import SCHEMES
from ..settings import (
    DISTANCE_SCALE,
    MAX_OUTPUT,
    OUTPUT_SCALE,
    RATE_ALLOWANCE,
    SEEN_ALLOWANCE,
    SPRING_ALLOWANCE,
    VELOCITY_SCALE,
    ModelConfig,
)

NORM_EPSILON = 1e-12  # far below any length that counts; its square's inverse is finite in float32


def soft_clamp(values: Tensor, bound: float) -> Tensor:
    """Clamp values smoothly to a bound b; a bound of zero changes zero.

    It is the identity up to h = b / 2, so that it does not damp states well within the bound. Beyond, it is
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

    `config.latent_bound` limits each new state, so that no rollout leaves the range that the decoder was trained on.

    Args:
        config: bounds and sizes.
        rates: number of last entries of a dynamic descriptor that are zero while the character holds still.

    Attributes:
        scheme: its entry in `schemes.SCHEMES`.
    """

    def __init__(self, config: ModelConfig, rates: int = 0) -> None:
        super().__init__()
        self.config, self.rates, self.scheme = config, rates, SCHEMES[config.scheme]

    def forward(
        self,
        stepper: nn.Module,
        before: Tensor,
        now: Tensor,
        rest: Tensor,
        pose: Tensor,
        seen: Tensor | None = None,
    ) -> Tensor:
        """Return z_t, shape (batch, latent).

        Args:
            stepper: the network S, from (batch, states * latent + pose + seen) to (batch, latent).
            before, now: z_{t-2} and z_{t-1}.
            rest: the quasi-static state P(theta_t) of the pose at t.
            pose: dynamic descriptor at t.
            seen: what S sees of the cloth before t (`network.feedback`); None where it sees none.
        """
        seen = now[:, :0] if seen is None else seen
        return self.step(stepper, before, now, self.precompute(stepper, rest, pose, seen.shape[1]), seen)

    def precompute(self, stepper: nn.Module, rest: Tensor, pose: Tensor, features: int) -> tuple[Tensor, ...]:
        """Return the inputs of `step` that depend on no state, for any number of frames at once.

        Args:
            features: number of those that S sees of the cloth.
        """
        return rest, pose

    def step(
        self, stepper: nn.Module, before: Tensor, now: Tensor, precomputed: Sequence[Tensor], seen: Tensor
    ) -> Tensor:
        """Return z_t, shape (batch, latent), from the two states before it, `precompute`d values and the cloth."""
        return self.clamp(self.advance(stepper, before, now, seen, *precomputed))

    def bound(self, rest: Tensor) -> Tensor:
        """Bound quasi-static states smoothly, so that P always has a gradient."""
        return soft_clamp(rest, self.config.latent_bound)

    def clamp(self, z: Tensor) -> Tensor:
        """Clamp states to `config.latent_bound`; a quasi-static one stays as it is, and so remains at rest."""
        bound = self.config.latent_bound
        return z.clamp(-bound, bound) if bound else z

    @abstractmethod
    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, seen: Tensor, *precomputed: Tensor) -> Tensor:
        """Return z_t before it is clamped, shape (batch, latent)."""


class SpringVerlet(Integrator):
    """Eqs. 2 and 3 about the quasi-static state p = P(theta_t), with a spring towards it.

        zbar = z_{t-1} + beta v,    v = z_{t-1} - z_{t-2},    f = k (p - zbar)
        z_t = zbar + f + u,         u = s (S(z_{t-1}, v, p - zbar, pose) - S(p, 0, 0, pose held still))

    Without S every dimension is a damped spring, stable for any k in (0, 1]. S learns what such a spring misses.
    The output of S for a garment at rest under a still character is subtracted, so that p is an equilibrium. The
    loss cannot enforce this: an error of a millimetre a frame is a tenth of gravity, and stretch and collisions
    hide it. Stiffnesses start spread from slow swings to quick following and stay under `config.stiffness`.
    `config.max_latent_step` limits spring and S together.

    p is the only equilibrium, whatever S has learned, because S gives at most half of what the spring gives, and
    more only while something moves, with a = `config.velocity_allowance`:

        |u| <= |f| / 2 + a |v| + |rates of the pose| / 20 + |what S sees of the cloth| / 4

    So nothing rests elsewhere. A swing is not bounded by this: S may add energy while something moves, as learned.
    Eq. 2's alpha is one: a larger one would undo the spring.

    S sees velocities and distances, scaled to order one. Given as states side by side they would be small
    differences of large inputs, which networks learn last. s is `OUTPUT_SCALE`.
    """

    slowest = 0.01

    def __init__(self, config: ModelConfig, rates: int = 0) -> None:
        super().__init__(config, rates)
        slowest = min(self.slowest, 0.05 * config.stiffness)
        start = torch.logspace(math.log10(slowest), math.log10(0.9 * config.stiffness), config.latent)
        # S can learn to make up for too much damping; too little would let oscillations grow.
        self.beta = nn.Parameter(torch.full((config.latent,), 0.7))
        self.share = nn.Parameter(torch.logit(start / config.stiffness))

    def precompute(self, stepper: nn.Module, rest: Tensor, pose: Tensor, features: int) -> tuple[Tensor, ...]:
        """Return the quasi-static state, the pose, the output of S at rest there, and |rates| / 20."""
        static, rates = pose.tensor_split([pose.shape[1] - self.rates], dim=1)
        # Not `len`, which would be a constant of an exported graph.
        zero, unseen = torch.zeros_like(rest), rest.new_zeros(rest.shape[0], features)
        at_rest = self._evaluate(stepper, rest, zero, zero, static, torch.zeros_like(rates), unseen)
        return rest, pose, at_rest, RATE_ALLOWANCE * length(rates)

    def step(
        self, stepper: nn.Module, before: Tensor, now: Tensor, precomputed: Sequence[Tensor], seen: Tensor
    ) -> Tensor:
        if torch.is_grad_enabled() or torch.compiler.is_compiling() or not kernels.supports(now):
            return super().step(stepper, before, now, precomputed, seen)
        from ...physics.kernels.spring import next_state_kernel, stepper_input_kernel

        rest, pose, at_rest, rate_allowance = precomputed
        scales = VELOCITY_SCALE, DISTANCE_SCALE
        inputs = torch.cat([pose, seen], dim=1)
        output = stepper(stepper_input_kernel(before, now, rest, inputs, self.beta, scales))
        rate_allowance = rate_allowance + SEEN_ALLOWANCE * length(seen)
        limits = (
            self.config.stiffness,
            MAX_OUTPUT,
            OUTPUT_SCALE,
            SPRING_ALLOWANCE,
            self.config.velocity_allowance,
            self.config.max_latent_step,
            self.config.latent_bound,
        )
        outputs, springs = (output, at_rest), (self.beta, self.share)
        return next_state_kernel((before, now), rest, outputs, rate_allowance, springs, limits)

    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, seen: Tensor, *precomputed: Tensor) -> Tensor:
        rest, pose, at_rest, rate_allowance = precomputed
        velocity = now - before
        forward = now + self.beta * velocity
        away = rest - forward
        output = self._evaluate(stepper, now, VELOCITY_SCALE * velocity, DISTANCE_SCALE * away, pose, seen)
        spring = self.config.stiffness * torch.sigmoid(self.share) * away
        allowance = SPRING_ALLOWANCE * length(spring) + self.config.velocity_allowance * length(velocity)
        allowance = allowance + rate_allowance + SEEN_ALLOWANCE * length(seen)
        learned = clip_norm(OUTPUT_SCALE * (output - at_rest), allowance)
        return forward + soft_clamp(spring + learned, self.config.max_latent_step)

    def _evaluate(self, stepper: nn.Module, *inputs: Tensor) -> Tensor:
        return stepper(torch.cat(inputs, dim=1)).clamp(-MAX_OUTPUT, MAX_OUTPUT)


class Verlet(Integrator):
    """The paper's own scheme: z_t = zbar + S([zbar, z_{t-1}, pose, cloth]) (Eqs. 2 and 3).

    zbar = alpha z_{t-1} + beta (z_{t-1} - z_{t-2}), and `config.max_latent_step` limits what S adds in a step. The
    paper does not say where alpha and beta start.
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


class QuasiStatic(Integrator):
    """z_t = P(theta_t), with no stepper and no earlier states, for garments without loose vertices."""

    def advance(self, stepper: nn.Module, before: Tensor, now: Tensor, seen: Tensor, *precomputed: Tensor) -> Tensor:
        return precomputed[0]


def integrator(config: ModelConfig, rates: int = 0) -> Integrator:
    """Return the integrator of a network's scheme; `rates` as in `Integrator`.

    Raises:
        TypeError: its parameters are not those that the registry names, by which model files are checked.
    """
    scheme = SCHEMES[config.scheme]
    module, _, name = scheme.integrator.partition(":")
    built: Integrator = getattr(importlib.import_module(module), name)(config, rates)
    found = {name for name, _ in built.named_parameters()}
    if found != set(scheme.parameters):
        raise TypeError(
            f"scheme '{config.scheme}' has the parameters {found}; the registry names {scheme.parameters}"
        )
    return built
