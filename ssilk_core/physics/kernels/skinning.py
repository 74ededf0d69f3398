# SPDX-License-Identifier: Apache-2.0
"""Linear blend skinning over sparse influences, and its gradients; reference: `skinning`.

A program is one warp: it owns a block of frames and processes a few vertices in turn, so that joints and weights are
scalars and matrices stay in the cache. Homogeneous coordinates run along the first axis of its tensors, which lies
in registers. The gradient of a matrix is gathered over its joint's vertices, in parts that are summed afterwards.
There are no atomics: results are deterministic.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from .vectors import dot, load3, store3

BLOCK = 128  # frames of one program
VERTICES = 1  # vertices that one program processes in turn


def skin_kernel(
    rest: Tensor,
    offsets: Tensor | None,
    weights: Tensor,
    matrices: Tensor,
    influences: tuple[Tensor, Tensor],
    movers: tuple[int, Tensor, Tensor],
) -> Tensor:
    """Return sum_i w_vi M_ji (rest + offsets), shape (V, 3, N); `rest` gets no gradient.

    Args:
        rest: points (V, 3); offsets: added to them (V, 3, N), or None.
        weights: of the influences (V, I); matrices: of all joints (J, 3, 4, N).
        influences: joints (V, I) and how many of them each vertex uses (V,), int32.
        movers: the joints whose matrices get a gradient: the first of T consecutive ones; their flat influences
            sorted by joint (E,); where the parts begin into which each joint's are split (T, parts + 1), int32.
    """
    offsets = None if offsets is None else offsets.contiguous()
    return _Skin.apply(rest, offsets, weights.contiguous(), matrices.contiguous(), *influences, *movers)


def skin_surface_kernel(
    points: Tensor, normals: Tensor, weights: Tensor, matrices: Tensor, influences: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """Return skinned points and unit normals (V, 3, N) of points and normals (V, 3), without gradients."""
    posed = matrices.new_empty(*points.shape, matrices.shape[-1])
    turned = posed.new_empty(posed.shape)
    _skin_surface[_grid(posed)](
        *(points, normals, *influences, weights, matrices.contiguous(), posed, turned),
        *(*weights.shape, posed.shape[2], VERTICES, BLOCK),
        num_warps=1,
    )
    return posed, turned


def _grid(values):
    return triton.cdiv(len(values), VERTICES), triton.cdiv(values.shape[2], BLOCK)


class _Skin(Function):
    @staticmethod
    def forward(ctx, rest, offsets, weights, matrices, joints, counts, trainable, entries, starts):
        ctx.save_for_backward(rest, offsets, weights, matrices, joints, counts, entries, starts)
        ctx.trainable = trainable
        posed = matrices.new_empty(*rest.shape, matrices.shape[-1])
        _skin[_grid(posed)](
            *(rest, offsets, joints, counts, weights, matrices, posed),
            *(*weights.shape, posed.shape[2], VERTICES, BLOCK),
            num_warps=1,
        )
        return posed

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream):
        rest, offsets, weights, matrices, joints, counts, entries, starts = ctx.saved_tensors
        upstream = upstream.contiguous()
        grad_offsets = None if offsets is None else offsets.new_empty(offsets.shape)
        grid = _grid(upstream)
        shares = weights.new_zeros(grid[1], *weights.shape)
        _skin_gradient[grid](
            *(rest, offsets, joints, counts, weights, matrices, upstream, grad_offsets, shares),
            *(*weights.shape, upstream.shape[2], VERTICES, BLOCK),
            num_warps=1,
        )
        grad_matrices = None
        if ctx.needs_input_grad[3] and len(starts):
            grad_matrices = matrices.new_zeros(matrices.shape)
            moved = grad_matrices[ctx.trainable : ctx.trainable + len(starts)]
            _matrix_gradient(rest, offsets, weights, upstream, entries, starts, moved)
        return None, grad_offsets, shares.sum(0), grad_matrices, *(None,) * 5


def _matrix_gradient(rest, offsets, weights, upstream, entries, starts, found):
    """Write the gradient of the trainable joints' matrices (T, 3, 4, N) to `found`."""
    joints, parts, frames = len(starts), starts.shape[1] - 1, upstream.shape[2]
    shares = upstream.new_empty(joints, parts, 12 * frames)
    _matrix_shares[parts * joints, triton.cdiv(frames, BLOCK)](
        *(rest, offsets, entries, starts, weights, upstream, shares, weights.shape[1], parts, frames, BLOCK),
        num_warps=1,
    )
    torch.sum(shares, 1, out=found.view(joints, 12 * frames))


@triton.jit
def _columns(frames, block: tl.constexpr):
    """Frames of a block (1, block), offsets of its four columns in a matrix row (4, block), and both masks."""
    n = tl.program_id(1) * block + tl.arange(0, block)[None, :]
    r = tl.arange(0, 4)[:, None]
    return n, r * frames + n, n < frames, (r < 3) & (n < frames)


@triton.jit
def _point(rest, offsets, v, cells, spatial, frames):
    """A vertex in homogeneous coordinates, (4, 1) or (4, block)."""
    r = tl.arange(0, 4)[:, None]
    point = tl.load(rest + v * 3 + r, mask=r < 3, other=1.0)
    if offsets is not None:
        point += tl.load(offsets + v * 3 * frames + cells, mask=spatial, other=0.0)
    return point


@triton.jit
def _influence(joints, weights, matrices, entry, cells, inside, frames):
    """The weight of an influence and the three rows of its joint's matrices, each (4, block)."""
    row = matrices + tl.load(joints + entry).to(tl.int64) * 12 * frames + cells
    x = tl.load(row, mask=inside, other=0.0)
    y = tl.load(row + 4 * frames, mask=inside, other=0.0)
    z = tl.load(row + 8 * frames, mask=inside, other=0.0)
    return tl.load(weights + entry), x, y, z


@triton.jit
def _skin(
    rest,
    offsets,
    joints,
    counts,
    weights,
    matrices,
    posed,
    vertices,
    influences,
    frames,
    each: tl.constexpr,
    block: tl.constexpr,
):
    n, cells, inside, spatial = _columns(frames, block)
    first = tl.program_id(0).to(tl.int64) * each
    for v in range(first, tl.minimum(first + each, vertices)):
        point = _point(rest, offsets, v, cells, spatial, frames)
        x = tl.zeros((block,), tl.float32)
        y, z = x, x
        for entry in range(v * influences, v * influences + tl.load(counts + v)):
            weight, mx, my, mz = _influence(joints, weights, matrices, entry, cells, inside, frames)
            x += weight * tl.sum(mx * point, 0)
            y += weight * tl.sum(my * point, 0)
            z += weight * tl.sum(mz * point, 0)
        store3(posed + v * 3 * frames, frames, n, inside, x[None, :], y[None, :], z[None, :])


@triton.jit
def _skin_surface(
    points,
    normals,
    joints,
    counts,
    weights,
    matrices,
    posed,
    turned,
    vertices,
    influences,
    frames,
    each: tl.constexpr,
    block: tl.constexpr,
):
    n, cells, inside, _ = _columns(frames, block)
    r = tl.arange(0, 4)[:, None]
    first = tl.program_id(0).to(tl.int64) * each
    for v in range(first, tl.minimum(first + each, vertices)):
        point = tl.load(points + v * 3 + r, mask=r < 3, other=1.0)
        normal = tl.load(normals + v * 3 + r, mask=r < 3, other=0.0)
        x = tl.zeros((block,), tl.float32)
        y, z, nx, ny, nz = x, x, x, x, x
        for entry in range(v * influences, v * influences + tl.load(counts + v)):
            weight, mx, my, mz = _influence(joints, weights, matrices, entry, cells, inside, frames)
            x += weight * tl.sum(mx * point, 0)
            y += weight * tl.sum(my * point, 0)
            z += weight * tl.sum(mz * point, 0)
            nx += weight * tl.sum(mx * normal, 0)
            ny += weight * tl.sum(my * normal, 0)
            nz += weight * tl.sum(mz * normal, 0)
        length = tl.maximum(tl.sqrt(dot(nx, ny, nz, nx, ny, nz)), 1e-8)
        nx, ny, nz = nx / length, ny / length, nz / length
        store3(posed + v * 3 * frames, frames, n, inside, x[None, :], y[None, :], z[None, :])
        store3(turned + v * 3 * frames, frames, n, inside, nx[None, :], ny[None, :], nz[None, :])


@triton.jit
def _skin_gradient(
    rest,
    offsets,
    joints,
    counts,
    weights,
    matrices,
    upstream,
    grad_offsets,
    shares,
    vertices,
    influences,
    frames,
    each: tl.constexpr,
    block: tl.constexpr,
):
    n, cells, inside, spatial = _columns(frames, block)
    shares += tl.program_id(1) * vertices * influences
    first = tl.program_id(0).to(tl.int64) * each
    for v in range(first, tl.minimum(first + each, vertices)):
        point = _point(rest, offsets, v, cells, spatial, frames)
        gx, gy, gz = load3(upstream + v * 3 * frames, frames, n, inside)
        back = tl.zeros((4, block), tl.float32)
        for entry in range(v * influences, v * influences + tl.load(counts + v)):
            weight, mx, my, mz = _influence(joints, weights, matrices, entry, cells, inside, frames)
            pulled = mx * gx + my * gy + mz * gz
            back += weight * pulled
            tl.store(shares + entry, tl.sum(tl.sum(pulled * point, 0), 0))
        if grad_offsets is not None:
            tl.store(grad_offsets + v * 3 * frames + cells, back, mask=spatial)


@triton.jit
def _matrix_shares(
    rest, offsets, entries, starts, weights, upstream, shares, influences, parts, frames, block: tl.constexpr
):
    n, cells, inside, spatial = _columns(frames, block)
    part = tl.program_id(0).to(tl.int64)
    start = starts + part // parts * (parts + 1) + part % parts
    x = tl.zeros((4, block), tl.float32)
    y, z = x, x
    for at in range(tl.load(start), tl.load(start + 1)):
        entry = tl.load(entries + at).to(tl.int64)
        v = entry // influences
        point = tl.load(weights + entry) * _point(rest, offsets, v, cells, spatial, frames)
        gx, gy, gz = load3(upstream + v * 3 * frames, frames, n, inside)
        x += gx * point
        y += gy * point
        z += gz * point
    row = shares + part * 12 * frames + cells
    tl.store(row, x, mask=inside)
    tl.store(row + 4 * frames, y, mask=inside)
    tl.store(row + 8 * frames, z, mask=inside)
