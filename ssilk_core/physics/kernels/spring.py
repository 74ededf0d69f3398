# SPDX-License-Identifier: Apache-2.0
"""A step of the damped spring in two launches; reference: `model.integrators.SpringVerlet.advance`.

A program owns a row. Steps are sequential and so small that launching a kernel takes longer than running it.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor


def stepper_input_kernel(
    before: Tensor, now: Tensor, rest: Tensor, pose: Tensor, beta: Tensor, scales: tuple[float, float]
) -> Tensor:
    """Return the input of S, [now, a v, b (rest - now - beta v), pose] with v = now - before, (rows, 3 latent + D).

    Args:
        before, now, rest: states (rows, latent), float32; pose: (rows, D); beta: (latent,).
        scales: a and b.
    """
    rows, latent = now.shape
    before, now, rest, pose = (values.contiguous() for values in (before, now, rest, pose))
    inputs = now.new_empty(rows, 3 * latent + pose.shape[1])
    _stepper_input[rows,](before, now, rest, pose, beta, inputs, *scales, latent, pose.shape[1],
                 triton.next_power_of_2(latent), triton.next_power_of_2(pose.shape[1]), num_warps=1)  # fmt: skip
    return inputs


def next_state_kernel(
    past: tuple[Tensor, Tensor],
    rest: Tensor,
    outputs: tuple[Tensor, Tensor],
    rate_allowance: Tensor,
    springs: tuple[Tensor, Tensor],
    limits: tuple[float, ...],
) -> Tensor:
    """Return the next state, clamped to its bound, shape (rows, latent).

    Args:
        past: z_{t-2} and z_{t-1}; rest: the quasi-static state; all (rows, latent), float32.
        outputs: the output of S for this frame, and at rest.
        rate_allowance: what the rates of the pose allow S to add, (rows, 1).
        springs: beta, and s (latent,) in k = stiffness / (1 + exp(-s)).
        limits: stiffness, max_output, output_scale, spring_allowance, velocity_allowance, max_step and bound.
    """
    rows, latent = rest.shape
    tensors = (values.contiguous() for values in (*past, rest, *outputs, rate_allowance, *springs))
    state = torch.empty_like(rest, memory_format=torch.contiguous_format)
    _next_state[rows,](*tensors, state, *limits, latent, triton.next_power_of_2(latent), num_warps=1)
    return state


@triton.jit
def _stepper_input(before, now, rest, pose, beta, inputs, of_velocity, of_distance, latent, sizes,
                   block: tl.constexpr, block_pose: tl.constexpr):  # fmt: skip
    row = tl.program_id(0).to(tl.int64)
    at = tl.arange(0, block)
    here = at < latent
    z, last = _rows(now, row, latent, at, here), _rows(before, row, latent, at, here)
    velocity = z - last
    forward = z + tl.load(beta + at, mask=here, other=0.0) * velocity
    away = _rows(rest, row, latent, at, here) - forward
    target = inputs + row * (3 * latent + sizes)
    tl.store(target + at, z, mask=here)
    tl.store(target + latent + at, of_velocity * velocity, mask=here)
    tl.store(target + 2 * latent + at, of_distance * away, mask=here)
    at_pose = tl.arange(0, block_pose)
    of_pose = at_pose < sizes
    tl.store(target + 3 * latent + at_pose, _rows(pose, row, sizes, at_pose, of_pose), mask=of_pose)


@triton.jit
def _next_state(before, now, rest, output, output_at_rest, rate_allowance, beta, share, state, stiffness, max_output,
                output_scale, spring_allowance, velocity_allowance, max_step, bound, latent,
                block: tl.constexpr):  # fmt: skip
    row = tl.program_id(0).to(tl.int64)
    at = tl.arange(0, block)
    here = at < latent
    z = _rows(now, row, latent, at, here)
    velocity = z - _rows(before, row, latent, at, here)
    forward = z + tl.load(beta + at, mask=here, other=0.0) * velocity
    constant = stiffness * tl.sigmoid(tl.load(share + at, mask=here, other=0.0))
    spring = constant * (_rows(rest, row, latent, at, here) - forward)
    clamped = _clamped(_rows(output, row, latent, at, here), max_output)
    added = output_scale * (clamped - _rows(output_at_rest, row, latent, at, here))
    of_state = spring_allowance * _length(spring) + velocity_allowance * _length(velocity)
    allowed = of_state + tl.load(rate_allowance + row)
    size = _length(added)
    longest = allowed / tl.where(size < 1e-12, 1e-12, size)
    added *= tl.where(longest > 1, 1.0, longest)  # unlike a maximum and a minimum these propagate NaN
    tl.store(
        state + row * latent + at, _hard_clamp(forward + _soft_clamp(spring + added, max_step), bound), mask=here
    )


@triton.jit
def _rows(values, row, width, at, here):
    return tl.load(values + row * width + at, mask=here, other=0.0)


@triton.jit
def _length(values):
    return tl.sqrt(tl.sum(values * values, axis=0))


@triton.jit
def _clamped(values, bound):
    """Clamp values to a bound; NaN stays NaN."""
    values = tl.where(values > bound, bound, values)
    return tl.where(values < -bound, -bound, values)


@triton.jit
def _hard_clamp(values, bound):
    """Clamp values to a bound; zero is none."""
    return tl.where(bound > 0, _clamped(values, bound), values)


@triton.jit
def _soft_clamp(values, bound):
    """`model.integrators.soft_clamp`; tanh x = 2 / (1 + exp(-2 x)) - 1."""
    half = bound / 2
    inner = _clamped(values, half)
    clamped = inner + half * (2 * tl.sigmoid(2 * (values - inner) / tl.maximum(half, 1e-30)) - 1)
    return tl.where(bound > 0, clamped, values)
