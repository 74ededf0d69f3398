# SPDX-License-Identifier: Apache-2.0
"""Energies of single vertices; reference: `GarmentEnergy.gravity`, `.collision_at`, `.inertia`, `.drag`.

A program owns a block of frames. For values it sums over a few vertices and writes this partial sum; for gradients it
owns one vertex. There are no atomics: results are deterministic.
"""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from .vectors import dot, load3, store3

FRAMES, WARPS = 128, 2  # frames and warps of one program
VERTICES = 16  # vertices that one program sums over


def gravity_kernel(x: Tensor, mass: Tensor, root: Tensor, gravity: Tensor) -> Tensor:
    """Return -sum m g.(x - root) [J], (N,).

    Args:
        x: positions (V, 3, N), the only argument with a gradient; mass: (V,).
        root: origin of heights (3, N); gravity: acceleration (3, N) or (3, 1).
    """
    rows = [values.detach().expand(3, x.shape[-1]).contiguous() for values in (root, gravity)]
    return _Gravity.apply(x.contiguous(), mass, *rows)


def contact_kernel(
    x: Tensor, area: Tensor, planes: tuple[Tensor, Tensor], stiffness: float, start: float, ramp: float
) -> Tensor:
    """Return the energy of contact of samples with planes [J], (N,); the law is `energy.collision.ContactLaw`.

    Args:
        x: positions of the samples (S, 3, N), the only argument with a gradient; area: (S, 1).
        planes: unit normals (S, 3, N) and offsets (S, N) of the plane that each sample collides with.
    """
    normal, offset = (values.detach().contiguous() for values in planes)
    return _Contact.apply(x.contiguous(), area, normal, offset, stiffness, start, ramp)


def inertia_and_drag_kernel(
    x: Tensor, mass: Tensor, last: Tensor, before: Tensor, shift: Tensor, inertia: float, drag: float
) -> tuple[Tensor, Tensor]:
    """Return inertia/2 sum m |x - 2 last + before|^2 and drag/2 sum m |x - last - shift|^2 [J], both (M,).

    Args:
        x: positions (V, 3, N), the only argument with a gradient; mass: (V,).
        last, before: positions one and two frames ago (V, 3, M), for the first M frames of x only.
        shift: displacement of the air since the last frame (3, M).
    """
    past = [_sliced(values.detach()) for values in (last, before)]
    return _InertiaAndDrag.apply(x.contiguous(), mass, *past, shift.detach().contiguous(), inertia, drag)


def _sliced(values: Tensor) -> Tensor:
    """Return (V, 3, M) as a slice of frames of a contiguous tensor, copied only where it is not one."""
    _, width, step = values.stride()
    return values if step == 1 and values.stride(0) == 3 * width else values.contiguous()


def _blocks(frames: int) -> int:
    return triton.cdiv(frames, FRAMES)


class _Gravity(Function):
    @staticmethod
    def forward(ctx, x, mass, root, gravity):
        vertices, _, frames = x.shape
        ctx.save_for_backward(mass, gravity)
        shares = x.new_empty(triton.cdiv(vertices, VERTICES), frames)
        _gravity[shares.shape[0], _blocks(frames)](
            *(x, mass, root, gravity, shares, vertices, frames, VERTICES, FRAMES), num_warps=WARPS
        )
        return shares.sum(0)

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream):
        mass, gravity = ctx.saved_tensors
        return -mass[:, None, None] * (gravity * upstream), *[None] * 3


class _Contact(Function):
    @staticmethod
    def forward(ctx, x, area, normal, offset, *law):
        samples, _, frames = x.shape
        ctx.save_for_backward(x, area, normal, offset)
        ctx.law = law
        shares = x.new_empty(triton.cdiv(samples, VERTICES), frames)
        _contact[shares.shape[0], _blocks(frames)](
            *(x, area, normal, offset, shares, *law, samples, frames, VERTICES, FRAMES), num_warps=WARPS
        )
        return shares.sum(0)

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream):
        x = ctx.saved_tensors[0]
        samples, _, frames = x.shape
        grad = x.new_empty(x.shape)
        _contact_gradient[samples, _blocks(frames)](
            *(*ctx.saved_tensors, upstream.contiguous(), grad, *ctx.law, frames, FRAMES), num_warps=WARPS
        )
        return grad, *[None] * 6


class _InertiaAndDrag(Function):
    @staticmethod
    def forward(ctx, x, mass, last, before, shift, inertia, drag):
        vertices, _, moving = last.shape
        ctx.save_for_backward(x, mass, last, before, shift)
        ctx.weights = inertia, drag
        ctx.sizes = x.stride(1), last.stride(1), before.stride(1), moving
        shares = x.new_empty(2, triton.cdiv(vertices, VERTICES), moving)
        _inertia_and_drag[shares.shape[1], _blocks(moving)](
            *(x, mass, last, before, shift, shares, inertia, drag),
            *(*ctx.sizes, vertices, VERTICES, FRAMES),
            num_warps=WARPS,
        )
        return tuple(shares.sum(1))

    @staticmethod
    @once_differentiable
    def backward(ctx, *upstream):
        x = ctx.saved_tensors[0]
        vertices, _, frames = x.shape
        grad = x.new_empty(x.shape)
        _inertia_and_drag_gradient[vertices, _blocks(frames)](
            *ctx.saved_tensors,
            *(values.contiguous() for values in upstream),
            *(grad, *ctx.weights, *ctx.sizes, FRAMES),
            num_warps=WARPS,
        )
        return grad, *[None] * 6


@triton.jit
def _gravity(x, mass, root, gravity, shares, vertices, frames, chunk: tl.constexpr, block: tl.constexpr):
    part = tl.program_id(0).to(tl.int64)
    n = tl.program_id(1) * block + tl.arange(0, block)
    inside = n < frames
    rx, ry, rz = load3(root, frames, n, inside)
    gx, gy, gz = load3(gravity, frames, n, inside)
    weight = tl.zeros((block,), tl.float32)
    first = part * chunk
    for v in range(first, tl.minimum(first + chunk, vertices)):
        px, py, pz = load3(x + v * 3 * frames, frames, n, inside)
        weight += tl.load(mass + v) * dot(px - rx, py - ry, pz - rz, gx, gy, gz)
    tl.store(shares + part * frames + n, -weight, mask=inside)


@triton.jit
def _depth(x, normal, offset, s, frames, n, inside, start):
    """Normal and depth of a sample below the distance at which contact begins; no depth is zero."""
    px, py, pz = load3(x + s * 3 * frames, frames, n, inside)
    nx, ny, nz = load3(normal + s * 3 * frames, frames, n, inside)
    depth = start - dot(nx, ny, nz, px, py, pz) + tl.load(offset + s * frames + n, mask=inside, other=0.0)
    return nx, ny, nz, tl.where(depth < 0, 0.0, depth)  # unlike a maximum this propagates NaN


@triton.jit
def _contact(x, area, normal, offset, shares, stiffness, start, ramp, samples, frames,
             chunk: tl.constexpr, block: tl.constexpr):  # fmt: skip
    part = tl.program_id(0).to(tl.int64)
    n = tl.program_id(1) * block + tl.arange(0, block)
    inside = n < frames
    energy = tl.zeros((block,), tl.float32)
    first = part * chunk
    for s in range(first, tl.minimum(first + chunk, samples)):
        _, _, _, depth = _depth(x, normal, offset, s, frames, n, inside, start)
        soft = depth * depth * depth / (6 * tl.maximum(ramp, 1e-12))
        deep = 0.5 * depth * (depth - ramp) + ramp * ramp / 6
        energy += tl.load(area + s) * tl.where(depth < ramp, soft, tl.where(depth == 0, 0.0, deep))
    tl.store(shares + part * frames + n, stiffness * energy, mask=inside)


@triton.jit
def _contact_gradient(x, area, normal, offset, upstream, grad, stiffness, start, ramp, frames,
                      block: tl.constexpr):  # fmt: skip
    s = tl.program_id(0).to(tl.int64)
    n = tl.program_id(1) * block + tl.arange(0, block)
    inside = n < frames
    nx, ny, nz, depth = _depth(x, normal, offset, s, frames, n, inside, start)
    deep = tl.where(depth == 0, 0.0, depth - 0.5 * ramp)
    pressure = tl.where(depth < ramp, depth * depth / (2 * tl.maximum(ramp, 1e-12)), deep)
    out = -stiffness * tl.load(area + s) * pressure * tl.load(upstream + n, mask=inside, other=0.0)
    store3(grad + s * 3 * frames, frames, n, inside, out * nx, out * ny, out * nz)


@triton.jit
def _moved(x, last, before, width, last_width, before_width, v, n, inside):
    """First and second backward differences of the position of vertex v."""
    px, py, pz = load3(x + v * 3 * width, width, n, inside)
    lx, ly, lz = load3(last + v * 3 * last_width, last_width, n, inside)
    bx, by, bz = load3(before + v * 3 * before_width, before_width, n, inside)
    dx, dy, dz = px - lx, py - ly, pz - lz
    return dx, dy, dz, dx - (lx - bx), dy - (ly - by), dz - (lz - bz)


@triton.jit
def _inertia_and_drag(
    x,
    mass,
    last,
    before,
    shift,
    shares,
    inertia,
    drag,
    width,
    last_width,
    before_width,
    moving,
    vertices,
    chunk: tl.constexpr,
    block: tl.constexpr,
):
    part = tl.program_id(0).to(tl.int64)
    n = tl.program_id(1) * block + tl.arange(0, block)
    inside = n < moving
    sx, sy, sz = load3(shift, moving, n, inside)
    thrown, blown = tl.zeros((block,), tl.float32), tl.zeros((block,), tl.float32)
    first = part * chunk
    for v in range(first, tl.minimum(first + chunk, vertices)):
        weight = tl.load(mass + v)
        dx, dy, dz, ax, ay, az = _moved(x, last, before, width, last_width, before_width, v, n, inside)
        thrown += weight * dot(ax, ay, az, ax, ay, az)
        dx, dy, dz = dx - sx, dy - sy, dz - sz
        blown += weight * dot(dx, dy, dz, dx, dy, dz)
    share = shares + part * moving + n
    tl.store(share, 0.5 * inertia * thrown, mask=inside)
    tl.store(share + tl.num_programs(0).to(tl.int64) * moving, 0.5 * drag * blown, mask=inside)


@triton.jit
def _inertia_and_drag_gradient(
    x,
    mass,
    last,
    before,
    shift,
    to_inertia,
    to_drag,
    grad,
    inertia,
    drag,
    width,
    last_width,
    before_width,
    moving,
    block: tl.constexpr,
):
    v = tl.program_id(0).to(tl.int64)
    n = tl.program_id(1) * block + tl.arange(0, block)
    inside = n < moving
    sx, sy, sz = load3(shift, moving, n, inside)
    dx, dy, dz, ax, ay, az = _moved(x, last, before, width, last_width, before_width, v, n, inside)
    weight = tl.load(mass + v)
    # Both are zero for frames without previous positions.
    thrown = inertia * weight * tl.load(to_inertia + n, mask=inside, other=0.0)
    blown = drag * weight * tl.load(to_drag + n, mask=inside, other=0.0)
    gx, gy, gz = thrown * ax + blown * (dx - sx), thrown * ay + blown * (dy - sy), thrown * az + blown * (dz - sz)
    store3(grad + v * 3 * width, width, n, n < width, gx, gy, gz)
