# SPDX-License-Identifier: Apache-2.0
"""Forward kinematics of proxies from what a network outputs, and its gradient; reference: `model.decoder`.

A loop owns some frames and goes over the proxies, parents first; for the gradient it goes backwards and adds each
proxy's gradient to its parent's.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from .compiling import compiled
from .running import array, run_parts

MIN_LENGTH = np.float32(1e-8)  # floor for the length that a vector is divided by


def proxies_loop(values: Tensor, pivots: Tensor, parents: Tensor, character: Tensor) -> Tensor:
    """Return skinning matrices of the character's joints, then of the proxies (J + P, 3, 4, N).

    Args:
        values: 6D rotations in bind-pose axes (P, 6, N), or these and displacements (P, 9, N) [m], the only argument
            with a gradient.
        pivots: bind positions (P, 3); parents: combined index of each proxy's parent, before its own (P,), integers.
        character: skinning matrices of the character's joints (J, 3, 4, N).
    """
    return _Proxies.apply(values, pivots, parents, character)


class _Proxies(Function):
    @staticmethod
    def forward(ctx, values, pivots, parents, character):
        matrices = torch.cat([character, character.new_empty(len(values), *character.shape[1:])])
        ctx.given = array(values), array(pivots), array(parents), matrices.detach().numpy()
        run_parts(_compose, values.shape[2], *ctx.given, len(character))
        return matrices

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream):
        values, _, _, matrices = ctx.given
        joints = len(matrices) - len(values)
        total = upstream[joints:].clone(memory_format=torch.contiguous_format)
        grad = torch.empty(values.shape)
        run_parts(_compose_gradient, values.shape[2], *ctx.given, joints, total.numpy(), grad.numpy())
        return grad, None, None, None


@compiled
def _axes(values, p, n):
    """The three axes of a 6D rotation by Gram-Schmidt, and both lengths that were divided by."""
    ax, ay, az = values[p, 0, n], values[p, 1, n], values[p, 2, n]
    bx, by, bz = values[p, 3, n], values[p, 4, n], values[p, 5, n]
    first = sqrt(ax * ax + ay * ay + az * az)
    scale = np.float32(1) / max(first, MIN_LENGTH)
    ax, ay, az = scale * ax, scale * ay, scale * az
    along = ax * bx + ay * by + az * bz
    bx, by, bz = bx - along * ax, by - along * ay, bz - along * az
    second = sqrt(bx * bx + by * by + bz * bz)
    scale = np.float32(1) / max(second, MIN_LENGTH)
    bx, by, bz = scale * bx, scale * by, scale * bz
    cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    return ax, ay, az, bx, by, bz, cx, cy, cz, first, second


@compiled
def _shift(values, pivots, p, n, ax, ay, az, bx, by, bz, cx, cy, cz):
    """The translation p - R p + t of a proxy in its parent's frame; t is zero where it does not move."""
    px, py, pz = pivots[p, 0], pivots[p, 1], pivots[p, 2]
    ox = px - (ax * px + bx * py + cx * pz)
    oy = py - (ay * px + by * py + cy * pz)
    oz = pz - (az * px + bz * py + cz * pz)
    if values.shape[1] > 6:
        ox, oy, oz = ox + values[p, 6, n], oy + values[p, 7, n], oz + values[p, 8, n]
    return ox, oy, oz


@compiled
def _compose(values, pivots, parents, matrices, joints, start, stop):
    for p in range(len(values)):
        above, made = matrices[parents[p]], matrices[joints + p]
        for n in range(start, stop):
            ax, ay, az, bx, by, bz, cx, cy, cz, _, _ = _axes(values, p, n)
            ox, oy, oz = _shift(values, pivots, p, n, ax, ay, az, bx, by, bz, cx, cy, cz)
            for row in range(3):
                sx, sy, sz = above[row, 0, n], above[row, 1, n], above[row, 2, n]
                made[row, 0, n] = sx * ax + sy * ay + sz * az
                made[row, 1, n] = sx * bx + sy * by + sz * bz
                made[row, 2, n] = sx * cx + sy * cy + sz * cz
                made[row, 3, n] = sx * ox + sy * oy + sz * oz + above[row, 3, n]


@compiled
def _direction_gradient(x, y, z, length, gx, gy, gz):
    """Gradient of a vector of a length from the gradient (gx, gy, gz) of its direction (x, y, z)."""
    along = x * gx + y * gy + z * gz if length >= MIN_LENGTH else np.float32(0)
    scale = np.float32(1) / max(length, MIN_LENGTH)
    return scale * (gx - along * x), scale * (gy - along * y), scale * (gz - along * z)


@compiled
def _compose_gradient(values, pivots, parents, matrices, joints, total, grad, start, stop):
    for p in range(len(values) - 1, -1, -1):
        parent, here = parents[p], total[p]
        px, py, pz = pivots[p, 0], pivots[p, 1], pivots[p, 2]
        for n in range(start, stop):
            ax, ay, az, bx, by, bz, cx, cy, cz, first, second = _axes(values, p, n)
            ox, oy, oz = _shift(values, pivots, p, n, ax, ay, az, bx, by, bz, cx, cy, cz)
            g = np.zeros(12, np.float32)
            for row in range(3):
                sx, sy, sz = matrices[parent, row, 0, n], matrices[parent, row, 1, n], matrices[parent, row, 2, n]
                for column in range(4):
                    pulled = here[row, column, n]
                    g[3 * column] += sx * pulled
                    g[3 * column + 1] += sy * pulled
                    g[3 * column + 2] += sz * pulled
                if parent >= joints:
                    ha, hb, hc, ho = here[row, 0, n], here[row, 1, n], here[row, 2, n], here[row, 3, n]
                    above = total[parent - joints]
                    above[row, 0, n] += ha * ax + hb * bx + hc * cx + ho * ox
                    above[row, 1, n] += ha * ay + hb * by + hc * cy + ho * oy
                    above[row, 2, n] += ha * az + hb * bz + hc * cz + ho * oz
                    above[row, 3, n] += ho
            gox, goy, goz = g[9], g[10], g[11]
            gax, gay, gaz = g[0] - px * gox, g[1] - px * goy, g[2] - px * goz
            gbx, gby, gbz = g[3] - py * gox, g[4] - py * goy, g[5] - py * goz
            gcx, gcy, gcz = g[6] - pz * gox, g[7] - pz * goy, g[8] - pz * goz
            # The third axis is a x b.
            gbx, gby, gbz = gbx + gcy * az - gcz * ay, gby + gcz * ax - gcx * az, gbz + gcx * ay - gcy * ax
            gax, gay, gaz = gax + by * gcz - bz * gcy, gay + bz * gcx - bx * gcz, gaz + bx * gcy - by * gcx
            gbx, gby, gbz = _direction_gradient(bx, by, bz, second, gbx, gby, gbz)
            # The second is v - (a.v) a before normalisation.
            vx, vy, vz = values[p, 3, n], values[p, 4, n], values[p, 5, n]
            along, part = ax * vx + ay * vy + az * vz, ax * gbx + ay * gby + az * gbz
            gax, gay, gaz = (
                gax - along * gbx - part * vx,
                gay - along * gby - part * vy,
                gaz - along * gbz - part * vz,
            )
            gax, gay, gaz = _direction_gradient(ax, ay, az, first, gax, gay, gaz)
            grad[p, 0, n], grad[p, 1, n], grad[p, 2, n] = gax, gay, gaz
            grad[p, 3, n], grad[p, 4, n], grad[p, 5, n] = gbx - part * ax, gby - part * ay, gbz - part * az
            if values.shape[1] > 6:
                grad[p, 6, n], grad[p, 7, n], grad[p, 8, n] = gox, goy, goz
