# SPDX-License-Identifier: Apache-2.0
"""Forward kinematics of proxies from what a network outputs, and its gradient; reference: `model.decoder`.

A program is one warp that owns a block of frames and iterates over the proxies, parents first. For the gradient it
iterates backwards and accumulates each proxy's gradient into its parent's. Programs share no frames: there are no
races.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from .vectors import cross, dot, load3, store3

BLOCK = 32  # frames of one program: few, since the loop over proxies is sequential
MIN_LENGTH = tl.constexpr(1e-8)  # floor for the length that a vector is divided by


def proxies_kernel(values: Tensor, pivots: Tensor, parents: Tensor, character: Tensor) -> Tensor:
    """Return skinning matrices of the character's joints, then of the proxies (J + P, 3, 4, N).

    Args:
        values: 6D rotations in bind-pose axes (P, 6, N), or these and displacements (P, 9, N) [m], the only argument
            with a gradient.
        pivots: bind positions (P, 3); parents: combined index of each proxy's parent, before its own (P,), int32.
        character: skinning matrices of the character's joints (J, 3, 4, N).
    """
    return _Proxies.apply(values.contiguous(), pivots, parents, character.detach())


class _Proxies(Function):
    @staticmethod
    def forward(ctx, values, pivots, parents, character):
        proxies, size, frames = values.shape
        matrices = character.new_empty(len(character) + proxies, *character.shape[1:])
        matrices[: len(character)] = character
        _compose[(triton.cdiv(frames, BLOCK),)](
            values, pivots, parents, matrices, len(character), proxies, frames, size, BLOCK, num_warps=1
        )
        ctx.save_for_backward(values, pivots, parents, matrices)
        return matrices

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream):
        values, pivots, parents, matrices = ctx.saved_tensors
        proxies, size, frames = values.shape
        joints = len(matrices) - proxies
        total = upstream[joints:].clone(memory_format=torch.contiguous_format)
        grad = torch.empty_like(values)
        _compose_gradient[(triton.cdiv(frames, BLOCK),)](
            values, pivots, parents, matrices, total, grad, joints, proxies, frames, size, BLOCK, num_warps=1
        )
        return grad, None, None, None


@triton.jit
def _unit(x, y, z):
    """A vector's direction, the inverse of its length, and whether the length is above `MIN_LENGTH`."""
    length = tl.sqrt(dot(x, y, z, x, y, z))
    scale = 1 / tl.maximum(length, MIN_LENGTH)
    return scale * x, scale * y, scale * z, scale, length >= MIN_LENGTH


@triton.jit
def _unit_gradient(x, y, z, scale, enough, gx, gy, gz):
    """Gradient of a vector from the gradient (gx, gy, gz) of its direction (x, y, z)."""
    along = tl.where(enough, dot(x, y, z, gx, gy, gz), 0.0)
    return scale * (gx - along * x), scale * (gy - along * y), scale * (gz - along * z)


@triton.jit
def _axes(six_d, frames, n, inside):
    """The three axes of a 6D rotation by Gram-Schmidt."""
    ax, ay, az = load3(six_d, frames, n, inside)
    bx, by, bz = load3(six_d + 3 * frames, frames, n, inside)
    ax, ay, az, _, _ = _unit(ax, ay, az)
    along = dot(ax, ay, az, bx, by, bz)
    bx, by, bz, _, _ = _unit(bx - along * ax, by - along * ay, bz - along * az)
    cx, cy, cz = cross(ax, ay, az, bx, by, bz)
    return ax, ay, az, bx, by, bz, cx, cy, cz


@triton.jit
def _axes_gradient(six_d, frames, n, inside, gax, gay, gaz, gbx, gby, gbz, gcx, gcy, gcz):
    """Gradient of a 6D rotation from those of its three axes."""
    ax, ay, az = load3(six_d, frames, n, inside)
    vx, vy, vz = load3(six_d + 3 * frames, frames, n, inside)
    ax, ay, az, scale_a, enough_a = _unit(ax, ay, az)
    along = dot(ax, ay, az, vx, vy, vz)
    bx, by, bz, scale_b, enough_b = _unit(vx - along * ax, vy - along * ay, vz - along * az)
    # The third axis is a x b.
    tx, ty, tz = cross(gcx, gcy, gcz, ax, ay, az)
    gvx, gvy, gvz = _unit_gradient(bx, by, bz, scale_b, enough_b, gbx + tx, gby + ty, gbz + tz)
    tx, ty, tz = cross(bx, by, bz, gcx, gcy, gcz)
    # The second is v - (a.v) a before normalisation.
    part = dot(ax, ay, az, gvx, gvy, gvz)
    gax, gay, gaz = gax + tx - along * gvx, gay + ty - along * gvy, gaz + tz - along * gvz
    gax, gay, gaz = gax - part * vx, gay - part * vy, gaz - part * vz
    gax, gay, gaz = _unit_gradient(ax, ay, az, scale_a, enough_a, gax, gay, gaz)
    return gax, gay, gaz, gvx - part * ax, gvy - part * ay, gvz - part * az


@triton.jit
def _kept(pivot, ax, ay, az, bx, by, bz, cx, cy, cz):
    """The translation p - R p that keeps a pivot in place."""
    px, py, pz = tl.load(pivot), tl.load(pivot + 1), tl.load(pivot + 2)
    return px - dot(ax, bx, cx, px, py, pz), py - dot(ay, by, cy, px, py, pz), pz - dot(az, bz, cz, px, py, pz)


@triton.jit
def _shift(own, pivot, frames, n, inside, ax, ay, az, bx, by, bz, cx, cy, cz, size: tl.constexpr):
    """The translation p - R p + t of a proxy in its parent's frame; t is zero where it does not move."""
    ox, oy, oz = _kept(pivot, ax, ay, az, bx, by, bz, cx, cy, cz)
    if size == 9:
        tx, ty, tz = load3(own + 6 * frames, frames, n, inside)
        ox, oy, oz = ox + tx, oy + ty, oz + tz
    return ox, oy, oz


@triton.jit
def _compose(values, pivots, parents, matrices, joints, proxies, frames, size: tl.constexpr, block: tl.constexpr):
    n = tl.program_id(0) * block + tl.arange(0, block)
    inside = n < frames
    for p in range(proxies):
        own = values + p * size * frames
        ax, ay, az, bx, by, bz, cx, cy, cz = _axes(own, frames, n, inside)
        ox, oy, oz = _shift(own, pivots + p * 3, frames, n, inside, ax, ay, az, bx, by, bz, cx, cy, cz, size)
        above = matrices + tl.load(parents + p) * 12 * frames
        made = matrices + (joints + p) * 12 * frames
        for row in tl.static_range(3):
            sx, sy, sz = load3(above + row * 4 * frames, frames, n, inside)
            shift = tl.load(above + (row * 4 + 3) * frames + n, mask=inside, other=0.0)
            a, b, c = dot(sx, sy, sz, ax, ay, az), dot(sx, sy, sz, bx, by, bz), dot(sx, sy, sz, cx, cy, cz)
            store3(made + row * 4 * frames, frames, n, inside, a, b, c)
            tl.store(made + (row * 4 + 3) * frames + n, dot(sx, sy, sz, ox, oy, oz) + shift, mask=inside)
        tl.debug_barrier()  # children read what was written


@triton.jit
def _compose_gradient(
    values, pivots, parents, matrices, total, grad, joints, proxies, frames, size: tl.constexpr, block: tl.constexpr
):
    n = tl.program_id(0) * block + tl.arange(0, block)
    inside = n < frames
    for done in range(proxies):
        p = proxies - 1 - done
        parent = tl.load(parents + p)
        own = values + p * size * frames
        ax, ay, az, bx, by, bz, cx, cy, cz = _axes(own, frames, n, inside)
        ox, oy, oz = _shift(own, pivots + p * 3, frames, n, inside, ax, ay, az, bx, by, bz, cx, cy, cz, size)
        gax = tl.zeros((block,), tl.float32)
        gay, gaz, gbx, gby, gbz, gcx, gcy, gcz, gox, goy, goz = gax, gax, gax, gax, gax, gax, gax, gax, gax, gax, gax
        for row in tl.static_range(3):
            sx, sy, sz = load3(matrices + (parent * 12 + row * 4) * frames, frames, n, inside)
            here = total + (p * 12 + row * 4) * frames
            ha, hb, hc = load3(here, frames, n, inside)
            ho = tl.load(here + 3 * frames + n, mask=inside, other=0.0)
            gax, gay, gaz = gax + sx * ha, gay + sy * ha, gaz + sz * ha
            gbx, gby, gbz = gbx + sx * hb, gby + sy * hb, gbz + sz * hb
            gcx, gcy, gcz = gcx + sx * hc, gcy + sy * hc, gcz + sz * hc
            gox, goy, goz = gox + sx * ho, goy + sy * ho, goz + sz * ho
            if parent >= joints:
                up = total + ((parent - joints) * 12 + row * 4) * frames
                ua, ub, uc = load3(up, frames, n, inside)
                uo = tl.load(up + 3 * frames + n, mask=inside, other=0.0)
                ua += dot(ha, hb, hc, ax, bx, cx) + ho * ox
                ub += dot(ha, hb, hc, ay, by, cy) + ho * oy
                uc += dot(ha, hb, hc, az, bz, cz) + ho * oz
                store3(up, frames, n, inside, ua, ub, uc)
                tl.store(up + 3 * frames + n, uo + ho, mask=inside)
        px, py, pz = tl.load(pivots + p * 3), tl.load(pivots + p * 3 + 1), tl.load(pivots + p * 3 + 2)
        gax, gay, gaz = gax - px * gox, gay - px * goy, gaz - px * goz
        gbx, gby, gbz = gbx - py * gox, gby - py * goy, gbz - py * goz
        gcx, gcy, gcz = gcx - pz * gox, gcy - pz * goy, gcz - pz * goz
        gax, gay, gaz, gbx, gby, gbz = _axes_gradient(
            own, frames, n, inside, gax, gay, gaz, gbx, gby, gbz, gcx, gcy, gcz
        )
        store3(grad + p * size * frames, frames, n, inside, gax, gay, gaz)
        store3(grad + (p * size + 3) * frames, frames, n, inside, gbx, gby, gbz)
        if size == 9:
            store3(grad + (p * size + 6) * frames, frames, n, inside, gox, goy, goz)
        tl.debug_barrier()  # a parent reads what its children added
