# SPDX-License-Identifier: Apache-2.0
"""Energies of single vertices; reference: `GarmentEnergy.collision_at`, `.inertia`, `.drag`.

A loop for values owns a block of frames and adds up all vertices in order; one for gradients owns vertices.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from .compiling import compiled
from .running import array, blocks_of, run_parts

LANES = 8  # frames that a loop processes at once, in one vector register

PART = 64  # vertices that are added up before their sum is, so that rounding errors stay small


def contact_loop(
    x: Tensor, area: Tensor, planes: tuple[Tensor, Tensor], stiffness: float, start: float, ramp: float
) -> Tensor:
    """Return the energy of contact of samples with planes [J], (N,); the law is `energy.collision.ContactLaw`.

    Args:
        x: positions of the samples (S, 3, N), the only argument with a gradient; area: (S, 1).
        planes: unit normals (S, 3, N) and offsets (S, N) of the plane that each sample collides with.
    """
    return _Contact.apply(x, area, *planes, tuple(np.float32(value) for value in (stiffness, start, ramp)))


def inertia_and_drag_loop(
    x: Tensor, mass: Tensor, last: Tensor, before: Tensor, shift: Tensor, inertia: float, drag: float
) -> tuple[Tensor, Tensor]:
    """Return inertia/2 sum m |x - 2 last + before|^2 and drag/2 sum m |x - last - shift|^2 [J], both (M,).

    Args:
        x: positions (V, 3, N), the only argument with a gradient; mass: (V,).
        last, before: positions one and two frames ago (V, 3, M), for the first M frames of x only.
        shift: displacement of the air since the last frame (3, M).
    """
    return _InertiaAndDrag.apply(x, mass, last, before, shift, np.float32(inertia), np.float32(drag))


class _Contact(Function):
    @staticmethod
    def forward(ctx, x, area, normal, offset, law):
        ctx.law, ctx.given = law, [array(values) for values in (x, area, normal, offset)]
        energy = torch.empty(x.shape[2])
        run_parts(_contact, blocks_of(x.shape[2], LANES), *ctx.given, *law, energy.numpy())
        return energy

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream):
        x = ctx.given[0]
        grad = torch.empty(x.shape)
        run_parts(_contact_gradient, len(x), *ctx.given, *ctx.law, array(upstream), grad.numpy())
        return grad, None, None, None, None


class _InertiaAndDrag(Function):
    @staticmethod
    def forward(ctx, x, mass, last, before, shift, inertia, drag):
        ctx.given, ctx.weights = [array(values) for values in (x, mass, last, before, shift)], (inertia, drag)
        energy = torch.empty(2, last.shape[2])
        run_parts(_inertia_and_drag, blocks_of(last.shape[2], LANES), *ctx.given, *ctx.weights, energy.numpy())
        return energy[0], energy[1]

    @staticmethod
    @once_differentiable
    def backward(ctx, to_inertia, to_drag):
        x = ctx.given[0]
        grad = torch.empty(x.shape)
        given = *ctx.given, *ctx.weights, array(to_inertia), array(to_drag), grad.numpy()
        run_parts(_inertia_and_drag_gradient, len(x), *given)
        return grad, *(None,) * 6


@compiled
def _contact(x, area, normal, offset, stiffness, begin, ramp, energy, start, stop):
    zero, half, six = np.float32(0), np.float32(0.5), np.float32(6)
    total = np.empty(LANES, np.float32)
    softness, level = six * max(ramp, np.float32(1e-12)), ramp * ramp / six
    for block in range(start, stop):
        first = block * LANES
        count = min(LANES, x.shape[2] - first)
        total[:] = 0
        for s in range(len(x)):
            for n in range(count):
                at = first + n
                gap = normal[s, 0, at] * x[s, 0, at] + normal[s, 1, at] * x[s, 1, at] + normal[s, 2, at] * x[s, 2, at]
                depth = begin - gap + offset[s, at]
                if not depth <= zero:  # NaN counts
                    deep = half * depth * (depth - ramp) + level
                    soft = depth * depth * depth / softness
                    total[n] += area[s, 0] * (soft if depth < ramp else deep)
        energy[first : first + count] = stiffness * total[:count]


@compiled
def _contact_gradient(x, area, normal, offset, stiffness, begin, ramp, upstream, grad, start, stop):
    zero, half, two = np.float32(0), np.float32(0.5), np.float32(2)
    softness = two * max(ramp, np.float32(1e-12))
    for s in range(start, stop):
        for n in range(x.shape[2]):
            gap = normal[s, 0, n] * x[s, 0, n] + normal[s, 1, n] * x[s, 1, n] + normal[s, 2, n] * x[s, 2, n]
            depth = begin - gap + offset[s, n]
            depth = zero if depth < zero else depth
            pressure = depth * depth / softness if depth < ramp else depth - half * ramp
            pressure = zero if depth == zero else pressure
            force = -stiffness * area[s, 0] * pressure * upstream[n]
            for axis in range(3):
                grad[s, axis, n] = force * normal[s, axis, n]


@compiled
def _inertia_and_drag(x, mass, last, before, shift, inertia, drag, energy, start, stop):
    half = np.float32(0.5)
    thrown, blown, total = (
        np.empty(LANES, np.float32),
        np.empty(LANES, np.float32),
        np.empty((2, LANES), np.float32),
    )
    for block in range(start, stop):
        first = block * LANES
        count = min(LANES, last.shape[2] - first)
        thrown[:], blown[:], total[:] = 0, 0, 0
        for v in range(len(x)):
            for axis in range(3):
                for n in range(count):
                    at = first + n
                    moved = x[v, axis, at] - last[v, axis, at]
                    turned = moved - (last[v, axis, at] - before[v, axis, at])
                    relative = moved - shift[axis, at]
                    thrown[n] += mass[v] * turned * turned
                    blown[n] += mass[v] * relative * relative
            if v % PART == PART - 1 or v == len(x) - 1:
                total[0] += thrown
                total[1] += blown
                thrown[:], blown[:] = 0, 0
        energy[0, first : first + count] = half * inertia * total[0, :count]
        energy[1, first : first + count] = half * drag * total[1, :count]


@compiled
def _inertia_and_drag_gradient(
    x, mass, last, before, shift, inertia, drag, to_inertia, to_drag, grad, start, stop
):  # fmt: skip
    moving = last.shape[2]
    for v in range(start, stop):
        thrown, blown = inertia * mass[v], drag * mass[v]
        for axis in range(3):
            for n in range(moving):
                moved = x[v, axis, n] - last[v, axis, n]
                turned = moved - (last[v, axis, n] - before[v, axis, n])
                relative = moved - shift[axis, n]
                grad[v, axis, n] = thrown * to_inertia[n] * turned + blown * to_drag[n] * relative
            for n in range(moving, x.shape[2]):
                grad[v, axis, n] = 0
