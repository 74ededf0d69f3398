# SPDX-License-Identifier: Apache-2.0
"""A step of the spring in two launches beside those of S; `model.integrators.SpringVerlet.advance` is the reference
implementation.

A program owns a row. Steps wait for one another, and so small that starting a kernel takes longer than running it.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor


def seen_kernel(
    before: Tensor, now: Tensor, rest: Tensor, pose: Tensor, beta: Tensor, scales: tuple[float, float]
) -> Tensor:
    """Return what S sees, [now, a v, b (rest - now - beta v), pose] with v = now - before, (rows, 3 latent + D).

    Args:
        before, now, rest: states (rows, latent), float32; pose: (rows, D); beta: (latent,).
        scales: a and b.
    """
    rows, latent = now.shape
    before, now, rest, pose = (values.contiguous() for values in (before, now, rest, pose))
    seen = now.new_empty(rows, 3 * latent + pose.shape[1])
    _seen[rows,](before, now, rest, pose, beta, seen, *scales, latent, pose.shape[1],
                 triton.next_power_of_2(latent), triton.next_power_of_2(pose.shape[1]), num_warps=1)  # fmt: skip
    return seen


def next_kernel(
    past: tuple[Tensor, Tensor],
    rest: Tensor,
    given: tuple[Tensor, Tensor],
    roused: Tensor,
    springs: tuple[Tensor, Tensor],
    limits: tuple[float, ...],
) -> Tensor:
    """Return the next state within its bound, shape (rows, latent).

    Args:
        past: the two states before; rest: the quasi-static one, all (rows, latent), float32.
        given: what S gives of the frame, and at rest.
        roused: what the motion of the pose allows, (rows, 1).
        springs: beta and the shares s (latent,) of k = stiffness / (1 + exp(-s)).
        limits: stiffness, the most that S gives, reach, own share, push and bound.
    """
    rows, latent = rest.shape
    tensors = (values.contiguous() for values in (*past, rest, *given, roused, *springs))
    state = torch.empty_like(rest, memory_format=torch.contiguous_format)
    _next[rows,](*tensors, state, *limits, latent, triton.next_power_of_2(latent), num_warps=1)
    return state


@triton.jit
def _seen(before, now, rest, pose, beta, seen, of_velocity, of_distance, latent, sizes, block: tl.constexpr,
          block_pose: tl.constexpr):  # fmt: skip
    row = tl.program_id(0).to(tl.int64)
    at = tl.arange(0, block)
    here = at < latent
    z, last = _rows(now, row, latent, at, here), _rows(before, row, latent, at, here)
    velocity = z - last
    forward = z + tl.load(beta + at, mask=here, other=0.0) * velocity
    away = _rows(rest, row, latent, at, here) - forward
    target = seen + row * (3 * latent + sizes)
    tl.store(target + at, z, mask=here)
    tl.store(target + latent + at, of_velocity * velocity, mask=here)
    tl.store(target + 2 * latent + at, of_distance * away, mask=here)
    at_pose = tl.arange(0, block_pose)
    of_pose = at_pose < sizes
    tl.store(target + 3 * latent + at_pose, _rows(pose, row, sizes, at_pose, of_pose), mask=of_pose)


@triton.jit
def _next(before, now, rest, moved, held, roused, beta, share, state, stiffness, most, reach, own_share, push, bound,
          latent, block: tl.constexpr):  # fmt: skip
    row = tl.program_id(0).to(tl.int64)
    at = tl.arange(0, block)
    here = at < latent
    z = _rows(now, row, latent, at, here)
    velocity = z - _rows(before, row, latent, at, here)
    forward = z + tl.load(beta + at, mask=here, other=0.0) * velocity
    constant = stiffness * tl.sigmoid(tl.load(share + at, mask=here, other=0.0))
    spring = constant * (_rows(rest, row, latent, at, here) - forward)
    added = reach * (_clamped(_rows(moved, row, latent, at, here), most) - _rows(held, row, latent, at, here))
    allowed = own_share * (_length(spring) + _length(velocity)) + tl.load(roused + row)
    size = _length(added)
    longest = allowed / tl.where(size < 1e-12, 1e-12, size)
    added *= tl.where(longest > 1, 1.0, longest)  # unlike a maximum and a minimum these pass NaN on
    tl.store(state + row * latent + at, _limited(forward + _limited(spring + added, push), bound), mask=here)


@triton.jit
def _rows(values, row, width, at, here):
    return tl.load(values + row * width + at, mask=here, other=0.0)


@triton.jit
def _length(values):
    return tl.sqrt(tl.sum(values * values, axis=0))


@triton.jit
def _clamped(values, most):
    """Values within a bound; what is not a number stays so."""
    values = tl.where(values > most, most, values)
    return tl.where(values < -most, -most, values)


@triton.jit
def _limited(values, bound):
    """`model.integrators.limited`; tanh x = 2 / (1 + exp(-2 x)) - 1."""
    half = bound / 2
    inner = _clamped(values, half)
    bent = inner + half * (2 * tl.sigmoid(2 * (values - inner) / tl.maximum(half, 1e-30)) - 1)
    return tl.where(bound > 0, bent, values)
