# SPDX-License-Identifier: Apache-2.0
"""Linear blend skinning over sparse influences, and its gradients; reference: `skinning`.

A loop owns a block of frames, whose matrices stay in the nearest cache. Gradients are added up in the order of the
vertices, those of weights in the order of the blocks: results are deterministic.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from .compiling import compiled
from .running import array, blocks_of, run_parts

LANES = 8  # frames that a loop processes at once, in one vector register


def skin_loop(
    rest: Tensor,
    offsets: Tensor | None,
    weights: Tensor,
    matrices: Tensor,
    influences: tuple[Tensor, Tensor],
    trainable: tuple[int, int],
) -> Tensor:
    """Return sum_i w_vi M_ji (rest + offsets), shape (V, 3, N); `rest` gets no gradient.

    Args:
        rest: points (V, 3); offsets: added to them (V, 3, N), or None.
        weights: of the influences (V, I); matrices: of all joints (J, 3, 4, N).
        influences: joints (V, I) and how many of them each vertex uses (V,), int32.
        trainable: first and end of the joints whose matrices get a gradient.
    """
    offsets = rest[:, :, None] if offsets is None else rest[:, :, None] + offsets
    return _Skin.apply(offsets, weights, matrices, *influences, trainable)


def skin_surface_loop(
    points: Tensor, normals: Tensor, weights: Tensor, matrices: Tensor, influences: tuple[Tensor, Tensor]
) -> tuple[Tensor, Tensor]:
    """Return skinned points and unit normals (V, 3, N) of points and normals (V, 3), without gradients."""
    frames = matrices.shape[3]
    posed, turned = matrices.new_empty(2, *points.shape, frames).unbind()
    given = (array(values) for values in (points, normals, *influences, weights, matrices.flatten(1, 2)))
    run_parts(_surface, blocks_of(frames, LANES), *given, posed.numpy(), turned.numpy())
    return posed, turned


class _Skin(Function):
    @staticmethod
    def forward(ctx, points, weights, matrices, joints, counts, trainable):
        given = points, joints, counts, weights, matrices.flatten(1, 2)
        ctx.given, ctx.trainable = [array(values) for values in given], trainable
        frames = matrices.shape[3]
        posed = matrices.new_empty(*points.shape[:2], frames)
        run_parts(_skin, blocks_of(frames, LANES), *ctx.given, posed.numpy())
        return posed

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream):
        (points, _, _, weights, matrices), (first, end) = ctx.given, ctx.trainable
        frames = upstream.shape[2]
        grad_points = upstream.new_empty(upstream.shape)
        shares = upstream.new_zeros(blocks_of(frames, LANES), *weights.shape)
        grad_matrices = upstream.new_zeros(matrices.shape)
        moved = ctx.needs_input_grad[2] and end > first
        out = array(upstream), grad_points.numpy(), shares.numpy(), grad_matrices.numpy()
        run_parts(_skin_gradient, len(shares), *ctx.given, *out, first, end if moved else first)
        if points.shape[2] == 1:
            grad_points = grad_points.sum(2, keepdim=True)
        found = grad_matrices.unflatten(1, (3, 4)) if moved else None
        return grad_points, shares.sum(0), found, None, None, None


@compiled
def _packed(values, first, packed):
    """Copy a block of frames of (P, C, N), or of (P, C, 1) for all frames, to (P, C, LANES); its end is repeated."""
    last = values.shape[2] - 1
    for row in range(len(values)):
        for axis in range(values.shape[1]):
            for n in range(LANES):
                packed[row, axis, n] = values[row, axis, min(first + n, last)]


@compiled
def _skin(points, joints, counts, weights, matrices, posed, start, stop):
    frames = matrices.shape[2]
    turn = np.empty((len(matrices), 12, LANES), np.float32)
    point, out = np.empty((3, LANES), np.float32), np.empty((3, LANES), np.float32)
    width = points.shape[2] - 1
    for block in range(start, stop):
        first = block * LANES
        count = min(LANES, frames - first)
        _packed(matrices, first, turn)
        for v in range(len(points)):
            for axis in range(3):
                for n in range(LANES):
                    point[axis, n] = points[v, axis, min(first + n, width)]
            out[:] = 0
            for entry in range(counts[v]):
                weight, m = weights[v, entry], turn[joints[v, entry]]
                for n in range(LANES):
                    x, y, z = point[0, n], point[1, n], point[2, n]
                    out[0, n] += weight * (m[0, n] * x + m[1, n] * y + m[2, n] * z + m[3, n])
                    out[1, n] += weight * (m[4, n] * x + m[5, n] * y + m[6, n] * z + m[7, n])
                    out[2, n] += weight * (m[8, n] * x + m[9, n] * y + m[10, n] * z + m[11, n])
            for axis in range(3):
                for n in range(count):
                    posed[v, axis, first + n] = out[axis, n]


@compiled
def _skin_gradient(
    points, joints, counts, weights, matrices, upstream, grad_points, shares, grad_matrices, moving, end, start, stop
):  # fmt: skip
    frames, width = matrices.shape[2], points.shape[2] - 1
    turn = np.empty((len(matrices), 12, LANES), np.float32)
    slope = np.empty((end - moving, 12, LANES), np.float32)
    point, pull = np.empty((3, LANES), np.float32), np.empty((3, LANES), np.float32)
    back, share = np.empty((3, LANES), np.float32), np.empty(LANES, np.float32)
    for block in range(start, stop):
        first = block * LANES
        count = min(LANES, frames - first)
        _packed(matrices, first, turn)
        slope[:] = 0
        for v in range(len(points)):
            for axis in range(3):
                for n in range(LANES):
                    point[axis, n] = points[v, axis, min(first + n, width)]
                    pull[axis, n] = upstream[v, axis, first + n] if n < count else np.float32(0)
            back[:] = 0
            for entry in range(counts[v]):
                joint, weight = joints[v, entry], weights[v, entry]
                m = turn[joint]
                for n in range(LANES):
                    x, y, z = point[0, n], point[1, n], point[2, n]
                    gx, gy, gz = pull[0, n], pull[1, n], pull[2, n]
                    px = m[0, n] * gx + m[4, n] * gy + m[8, n] * gz
                    py = m[1, n] * gx + m[5, n] * gy + m[9, n] * gz
                    pz = m[2, n] * gx + m[6, n] * gy + m[10, n] * gz
                    share[n] = px * x + py * y + pz * z + m[3, n] * gx + m[7, n] * gy + m[11, n] * gz
                    back[0, n] += weight * px
                    back[1, n] += weight * py
                    back[2, n] += weight * pz
                total = np.float32(0)
                for n in range(LANES):
                    total += share[n]
                shares[block, v, entry] = total
                if moving <= joint < end:
                    row = slope[joint - moving]
                    for axis in range(3):
                        for n in range(LANES):
                            pulled = weight * pull[axis, n]
                            row[4 * axis, n] += pulled * point[0, n]
                            row[4 * axis + 1, n] += pulled * point[1, n]
                            row[4 * axis + 2, n] += pulled * point[2, n]
                            row[4 * axis + 3, n] += pulled
            for axis in range(3):
                for n in range(count):
                    grad_points[v, axis, first + n] = back[axis, n]
        for joint in range(moving, end):
            for place in range(12):
                for n in range(count):
                    grad_matrices[joint, place, first + n] = slope[joint - moving, place, n]


@compiled
def _surface(points, normals, joints, counts, weights, matrices, posed, turned, start, stop):
    frames = matrices.shape[2]
    turn, blend = np.empty((len(matrices), 12, LANES), np.float32), np.empty((12, LANES), np.float32)
    for block in range(start, stop):
        first = block * LANES
        count = min(LANES, frames - first)
        _packed(matrices, first, turn)
        for v in range(len(points)):
            blend[:] = 0
            for entry in range(counts[v]):
                weight, m = weights[v, entry], turn[joints[v, entry]]
                for place in range(12):
                    for n in range(LANES):
                        blend[place, n] += weight * m[place, n]
            x, y, z = points[v, 0], points[v, 1], points[v, 2]
            a, b, c = normals[v, 0], normals[v, 1], normals[v, 2]
            for n in range(count):
                nx = blend[0, n] * a + blend[1, n] * b + blend[2, n] * c
                ny = blend[4, n] * a + blend[5, n] * b + blend[6, n] * c
                nz = blend[8, n] * a + blend[9, n] * b + blend[10, n] * c
                length = np.float32(1) / max(sqrt(nx * nx + ny * ny + nz * nz), np.float32(1e-8))
                at = first + n
                turned[v, 0, at], turned[v, 1, at], turned[v, 2, at] = nx * length, ny * length, nz * length
                posed[v, 0, at] = blend[0, n] * x + blend[1, n] * y + blend[2, n] * z + blend[3, n]
                posed[v, 1, at] = blend[4, n] * x + blend[5, n] * y + blend[6, n] * z + blend[7, n]
                posed[v, 2, at] = blend[8, n] * x + blend[9, n] * y + blend[10, n] * z + blend[11, n]
