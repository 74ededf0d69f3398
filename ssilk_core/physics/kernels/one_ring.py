# SPDX-License-Identifier: Apache-2.0
"""The nearest point on the triangles around the nearest body vertex; reference: `collision.distance`.

A program owns one garment vertex in a block of frames: its threads mostly visit the same few triangles, and
consecutive frames are contiguous in memory.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from .vectors import dot, load3, store3

BLOCK = 32  # frames of one program
TINY = tl.constexpr(1e-30)


def one_ring_kernel(
    x: Tensor,
    index: Tensor,
    points: Tensor,
    normals: Tensor,
    rings: Tensor,
    max_distance: float,
    reach: float,
    on_triangles: bool,
) -> tuple[Tensor, Tensor]:
    """Return unit normals (V, 3, N) and offsets n . b (V, N) of the nearest body points b.

    Args:
        x: queries (V, 3, N); index: their nearest body vertices (V, N), int32.
        points, normals: of the body (B, 3, N).
        rings: neighbours around each vertex (`collision.one_ring.triangle_rings`), int32.
        max_distance: queries further than this from their nearest vertex [m], or further than `reach` from the
            nearest point, use that vertex as the nearest point, with the direction from there.
        on_triangles: whether triangles are the surface, or vertices, over whose tangent planes `reach` bounds the
            height.
    """
    x, points, normals = x.contiguous(), points.contiguous(), normals.contiguous()
    vertices, _, frames = x.shape
    assert points.numel() < 1 << 31  # body vertices are addressed by 32 bits
    normal, offset = torch.empty_like(x), x.new_empty(vertices, frames)
    grid = (vertices, triton.cdiv(frames, BLOCK))
    _surface[grid](x, index, points, normals, rings, normal, offset, frames, rings.shape[1],
                   max_distance * max_distance, reach * reach, on_triangles, BLOCK,
                   num_warps=1)  # fmt: skip
    return normal, offset


@triton.jit
def _surface(
    x,
    index,
    points,
    normals,
    rings,
    normal,
    offset,
    frames,
    width,
    max_square,
    reach_square,
    on_triangles: tl.constexpr,
    block: tl.constexpr,
):
    v = tl.program_id(0).to(tl.int64)
    n = tl.program_id(1) * block + tl.arange(0, block)
    inside = n < frames
    first = tl.load(index + v * frames + n, mask=inside, other=0)
    ox, oy, oz = load3(points + first * 3 * frames, frames, n, inside)
    px, py, pz = load3(x + v * 3 * frames, frames, n, inside)
    px, py, pz = px - ox, py - oy, pz - oz
    near = inside & (dot(px, py, pz, px, py, pz) < max_square)
    ring = rings + first * width
    zero = tl.zeros_like(px)
    best, s_best, t_best, j_best, k_best = zero, zero, zero, first, first
    k, wx, wy, wz = first, zero, zero, zero
    for step in range(1, 1 + tl.max(tl.load(ring, mask=near, other=0), axis=0)):
        j, ux, uy, uz = k, wx, wy, wz
        k = tl.load(ring + step, mask=near, other=0)
        wx, wy, wz = load3(points + k * 3 * frames, frames, n, near)
        wx, wy, wz = wx - ox, wy - oy, wz - oz
        s, t, e = _closest(px, py, pz, ux, uy, uz, wx, wy, wz)
        closer = near & (e < best)
        best, s_best, t_best = tl.where(closer, e, best), tl.where(closer, s, s_best), tl.where(closer, t, t_best)
        j_best, k_best = tl.where(closer, j, j_best), tl.where(closer, k, k_best)
    away = dot(px, py, pz, px, py, pz) + best
    if not on_triangles:
        nx, ny, nz = load3(normals + first * 3 * frames, frames, n, inside)
        height = dot(nx, ny, nz, px, py, pz)
        away = height * height
    near = near & (away < reach_square)
    s_best, t_best = tl.where(near, s_best, 0.0), tl.where(near, t_best, 0.0)
    bx, by, bz = _mixed(points, frames, first, j_best, k_best, s_best, t_best, n, inside, near)
    nx, ny, nz = _mixed(normals, frames, first, j_best, k_best, s_best, t_best, n, inside, near)
    length = tl.maximum(tl.sqrt(dot(nx, ny, nz, nx, ny, nz)), 1e-8)
    nx, ny, nz = nx / length, ny / length, nz / length
    length = tl.sqrt(tl.maximum(dot(px, py, pz, px, py, pz), TINY))
    nx, ny, nz = tl.where(near, nx, px / length), tl.where(near, ny, py / length), tl.where(near, nz, pz / length)
    store3(normal + v * 3 * frames, frames, n, inside, nx, ny, nz)
    tl.store(offset + v * frames + n, dot(nx, ny, nz, bx, by, bz), mask=inside)


@triton.jit
def _closest(px, py, pz, ux, uy, uz, wx, wy, wz):
    """Minimise |p - s u - t w|^2 over s, t >= 0, s + t <= 1; return s, t and the minimum minus |p|^2.

    The edge along u is skipped, since it was the edge along w of the previous triangle.
    """
    d1, d2 = dot(ux, uy, uz, px, py, pz), dot(wx, wy, wz, px, py, pz)
    a, b, c = dot(ux, uy, uz, ux, uy, uz), dot(ux, uy, uz, wx, wy, wz), dot(wx, wy, wz, wx, wy, wz)
    determinant = tl.maximum(a * c - b * b, TINY)
    s, t = (c * d1 - b * d2) / determinant, (a * d2 - b * d1) / determinant
    within = (s >= 0) & (t >= 0) & (s + t <= 1)
    s, t = tl.where(within, s, 0.0), tl.where(within, t, 0.0)
    e = s * (s * a - 2 * d1) + t * (t * c - 2 * d2) + 2 * s * t * b
    alone = _clamped(d2, c)
    value = alone * (alone * c - 2 * d2)
    s, t, e = tl.where(value < e, 0.0, s), tl.where(value < e, alone, t), tl.minimum(value, e)
    opposite, length = d2 - d1 - b + a, a - 2 * b + c
    along = _clamped(opposite, length)
    value = a - 2 * d1 + along * (along * length - 2 * opposite)
    return tl.where(value < e, 1 - along, s), tl.where(value < e, along, t), tl.minimum(value, e)


@triton.jit
def _closest_alone(px, py, pz, ux, uy, uz, wx, wy, wz):
    """`_closest` for a single triangle, which includes the edge along u."""
    s, t, e = _closest(px, py, pz, ux, uy, uz, wx, wy, wz)
    along, length = dot(ux, uy, uz, px, py, pz), dot(ux, uy, uz, ux, uy, uz)
    alone = _clamped(along, length)
    value = alone * (alone * length - 2 * along)
    return tl.where(value < e, alone, s), tl.where(value < e, 0.0, t), tl.minimum(value, e)


@triton.jit
def _clamped(part, whole):
    return tl.minimum(tl.maximum(part / tl.maximum(whole, TINY), 0.0), 1.0)


@triton.jit
def _mixed(values, frames, i, j, k, s, t, n, inside, near):
    """Interpolate (1 - s - t) of vertex i, s of j and t of k; j and k are loaded only where `near`."""
    ix, iy, iz = load3(values + i * 3 * frames, frames, n, inside)
    jx, jy, jz = load3(values + j * 3 * frames, frames, n, near)
    kx, ky, kz = load3(values + k * 3 * frames, frames, n, near)
    r = 1 - s - t
    return r * ix + s * jx + t * kx, r * iy + s * jy + t * ky, r * iz + s * jz + t * kz
