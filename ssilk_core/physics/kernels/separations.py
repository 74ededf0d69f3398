# SPDX-License-Identifier: Apache-2.0
"""How vertices are separated from faces, and edges from edges; reference: `self_contact.pairs`.

A program owns a block of pairs, each in a frame of its own.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from .one_ring import _closest_alone
from .vectors import cross, dot

BLOCK = 128  # pairs of one program
TINY = tl.constexpr(1e-24)
PARALLEL = tl.constexpr(1e-4)  # as in `pairs`
# Arguments whose sizes and addresses differ from call to call: kernels are not compiled for each kind of these.
VARYING = [
    "count", "found", "total", "writes", "offset", "frame", "one", "other", "known", "side", "sides", "numbers",
    "facing", "whole", "seconds", "vertices", "coefficients", "direction", "slack", "begun", "area", "pairs",
    "distance",
]  # fmt: skip


def separations_kernel(
    x: Tensor, first: Tensor, second: Tensor, frame: Tensor, one: Tensor, other: Tensor
) -> tuple[Tensor, ...]:
    """Return what `pairs.Separations` holds, in its order, of pairs at positions x (V, 3, N), or (V, 3, 1) for all.

    Args:
        first, second: vertices of what comes first in pairs, and second, shapes (A, 1) and (B, 3), or both (A, 2).
        frame, one, other: of each pair, int64, shape (P,).
    """
    x, count = x.contiguous(), len(frame)
    numbers = x.new_empty(12, count)  # as rows: coefficients, direction, normal, distance, height
    facing = torch.empty(count, dtype=torch.bool, device=x.device)
    if count:
        _separations[(triton.cdiv(count, BLOCK),)](
            x, first, second, frame, one, other, numbers, facing, count, x.shape[-1], x.shape[-1] > 1,
            first.shape[1] == 1, BLOCK, num_warps=4,
        )  # fmt: skip
    return numbers[:4], numbers[10], numbers[4:7], facing, numbers[7:10], numbers[11]


@triton.jit(do_not_specialize=VARYING, do_not_specialize_on_alignment=VARYING)
def _separations(
    x, first, second, frame, one, other, numbers, facing, count, frames,
    several: tl.constexpr, faces: tl.constexpr, block: tl.constexpr,
):  # fmt: skip
    n = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    inside = n < count
    f = n * 0
    if several:
        f = tl.load(frame + n, mask=inside, other=0)
    _p, _q, i, j, k, o = four_vertices(first, second, one, other, n, inside, faces)
    rx, ry, rz, ax, ay, az, nx, ny, nz, c1, c2, c3, faced = apart(x + f, frames, i, j, k, o, faces)
    distance, across = tl.sqrt(dot(rx, ry, rz, rx, ry, rz)), tl.sqrt(dot(nx, ny, nz, nx, ny, nz))
    away, across = tl.maximum(distance, TINY), tl.maximum(across, TINY)
    nx, ny, nz = nx / across, ny / across, nz / across
    row = numbers + n
    tl.store(row, -c1 - c2 - c3, mask=inside)
    tl.store(row + count, c1, mask=inside)
    tl.store(row + 2 * count, c2, mask=inside)
    tl.store(row + 3 * count, c3, mask=inside)
    tl.store(row + 4 * count, rx / away, mask=inside)
    tl.store(row + 5 * count, ry / away, mask=inside)
    tl.store(row + 6 * count, rz / away, mask=inside)
    tl.store(row + 7 * count, nx, mask=inside)
    tl.store(row + 8 * count, ny, mask=inside)
    tl.store(row + 9 * count, nz, mask=inside)
    tl.store(row + 10 * count, distance, mask=inside)
    tl.store(row + 11 * count, dot(ax, ay, az, nx, ny, nz), mask=inside)
    tl.store(facing + n, faced, mask=inside)


@triton.jit
def four_vertices(first, second, one, other, n, inside, faces: tl.constexpr):
    """What comes first and second in pairs, and their four vertices."""
    p = tl.load(one + n, mask=inside, other=0)
    q = tl.load(other + n, mask=inside, other=0)
    first += p * (1 if faces else 2)
    second += q * (3 if faces else 2)
    i, o = tl.load(first), tl.load(second + (2 if faces else 1))
    if faces:
        j, k = tl.load(second), tl.load(second + 1)
    else:
        j, k = tl.load(first + 1), tl.load(second)
    return p, q, i, j, k, o


@triton.jit
def at_vertex(x, frames, v):
    """The three coordinates of vertices, each in its own frame."""
    return tl.load(x + v * 3 * frames), tl.load(x + (v * 3 + 1) * frames), tl.load(x + (v * 3 + 2) * frames)


@triton.jit
def apart(x, frames, i, j, k, o, faces: tl.constexpr):
    """The vector between the nearest points, the arm between the first corners, the normal (not of unit length), the
    coefficients of all but the first corner, and whether the points lie within."""
    ix, iy, iz = at_vertex(x, frames, i)
    jx, jy, jz = at_vertex(x, frames, j)
    kx, ky, kz = at_vertex(x, frames, k)
    ox, oy, oz = at_vertex(x, frames, o)
    if faces:
        ux, uy, uz, vx, vy, vz = kx - jx, ky - jy, kz - jz, ox - jx, oy - jy, oz - jz
        ax, ay, az = ix - jx, iy - jy, iz - jz
        s, t, _ = _closest_alone(ax, ay, az, ux, uy, uz, vx, vy, vz)
        rx, ry, rz = ax - s * ux - t * vx, ay - s * uy - t * vy, az - s * uz - t * vz
        c1, c2, c3 = s + t - 1, -s, -t
        faced = (s > 0) & (t > 0) & (s + t < 1)
    else:
        ux, uy, uz, vx, vy, vz = jx - ix, jy - iy, jz - iz, ox - kx, oy - ky, oz - kz
        ax, ay, az = ix - kx, iy - ky, iz - kz
        ff, ss, fs = dot(ux, uy, uz, ux, uy, uz), dot(vx, vy, vz, vx, vy, vz), dot(ux, uy, uz, vx, vy, vz)
        fa, sa = dot(ux, uy, uz, ax, ay, az), dot(vx, vy, vz, ax, ay, az)
        determinant = ff * ss - fs * fs
        s = _clamped(fs * sa - ss * fa, determinant)
        t = (fs * s + sa) / tl.maximum(ss, TINY)
        beyond = (t < 0) | (t > 1)
        t = tl.minimum(tl.maximum(t, 0.0), 1.0)
        s = tl.where(beyond, _clamped(fs * t - fa, ff), s)
        rx, ry, rz = ax + s * ux - t * vx, ay + s * uy - t * vy, az + s * uz - t * vz
        c1, c2, c3 = s, t - 1, -t
        faced = (determinant > ff * ss * PARALLEL) & (s > 0) & (s < 1) & (t > 0) & (t < 1)
    nx, ny, nz = cross(ux, uy, uz, vx, vy, vz)
    return rx, ry, rz, ax, ay, az, nx, ny, nz, c1, c2, c3, faced


@triton.jit
def _clamped(part, whole):
    return tl.minimum(tl.maximum(part / tl.maximum(whole, TINY), 0.0), 1.0)
