# SPDX-License-Identifier: Apache-2.0
"""The smoothed distance to a body's surface; reference: `collision.smoothed_distance`.

A program owns one garment vertex in a block of frames. It iterates over the vertex's triangles and evaluates those
whose bounding sphere is within reach in any of the frames. Sums are kept relative to the nearest triangle so far, so
that one pass suffices.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from .one_ring import _closest_alone, _mixed
from .vectors import dot, load3, store3

BLOCK = 32  # frames of one program
TINY = tl.constexpr(1e-30)


def smoothed_distance_kernel(
    x: Tensor,
    index: Tensor,
    points: Tensor,
    normals: Tensor,
    faces: Tensor,
    spheres: Tensor,
    candidates: Tensor | None,
    *,
    max_distance: float,
    max_depth: float,
    reach: float,
    deep_cosine: float,
    surface_epsilon: float,
    exponent: float,
    search_margin: float,
    edge_epsilon: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return gradients (V, 3, N), smoothed distances (V, N) and their curvature (V, 3, 3, N).

    The values are those of `collision.smoothed_distance.smoothed_distance`. For queries further than `max_distance`
    from the nearest vertex, or than `reach` from every triangle, they are those of the vertex itself. Without
    `candidates`, queries behind its tangent plane and within `max_depth` are searched for, too.

    Args:
        x: queries (V, 3, N); index: their nearest body vertices (V, N), int32.
        points, normals: of the body (B, 3, N).
        faces: triangles (F, 3), and `spheres` around them: centre and radius, (F, 4, N).
        candidates: triangles that each query can find, padded with -1, shape (V, L); None for all.
    """
    x, points, normals = x.contiguous(), points.contiguous(), normals.contiguous()
    vertices, _, frames = x.shape
    assert points.numel() < 1 << 31  # body vertices are addressed by 32 bits
    faces, spheres = faces.int().contiguous(), spheres.contiguous()
    table = faces.new_zeros(1) if candidates is None else candidates.int().contiguous()
    width = len(faces) if candidates is None else candidates.shape[1]
    normal, distance = torch.empty_like(x), x.new_empty(vertices, frames)
    curvature = x.new_empty(vertices, 3, 3, frames)
    grid = (vertices, triton.cdiv(frames, BLOCK))
    _smoothed[grid](x, index, points, normals, faces, spheres, table, normal, distance, curvature, frames, width,
                    max_distance * max_distance, max_depth * max_depth, max_distance, min(reach, 1e29), deep_cosine,
                    surface_epsilon, exponent, edge_epsilon, 1 + search_margin,
                    candidates is not None, BLOCK, num_warps=1)  # fmt: skip
    return normal, distance, curvature


@triton.jit
def _smoothed(x, index, points, normals, faces, spheres, table, normal, distances, curvature, frames, width,
              max_square, deepest, max_distance, reach, deep_cosine, surface_epsilon, exponent, edge_epsilon,
              search_margin, candidates: tl.constexpr, block: tl.constexpr):  # fmt: skip
    v = tl.program_id(0).to(tl.int64)
    n = tl.program_id(1) * block + tl.arange(0, block)
    inside = n < frames
    first = tl.load(index + v * frames + n, mask=inside, other=0)
    qx, qy, qz = load3(x + v * 3 * frames, frames, n, inside)
    ox, oy, oz = load3(points + first * 3 * frames, frames, n, inside)
    mx, my, mz = load3(normals + first * 3 * frames, frames, n, inside)
    square = dot(qx - ox, qy - oy, qz - oz, qx - ox, qy - oy, qz - oz)
    near = inside & (square < max_square)
    if not candidates:
        near = near | (inside & (square < deepest) & (dot(mx, my, mz, qx - ox, qy - oy, qz - oz) < 0))
    length = tl.sqrt(tl.maximum(square, TINY))
    mx, my, mz = (qx - ox) / length, (qy - oy) / length, (qz - oz) / length
    radius = tl.sqrt(square) * search_margin * 1.000001  # the nearest vertex is not nearer than the nearest point
    zero = tl.zeros_like(qx)
    best = zero + 1e30
    i_best, j_best, k_best, s_best, t_best = first, first, first, zero, zero
    wx, wy, wz = zero, zero, zero  # direction away from the nearest
    total, gx, gy, gz, hx, hy, hz = zero, zero, zero, zero, zero, zero, zero
    xx, xy, xz, yy, yz, zz = zero, zero, zero, zero, zero, zero
    for place in range(tl.where(tl.max(near.to(tl.int32), axis=0) > 0, width, 0)):
        face = place
        if candidates:
            face = tl.load(table + v * width + place)
        there = near & (zero + face >= 0)
        face = tl.maximum(face, 0)
        ball = spheres + face.to(tl.int64) * 4 * frames
        ax, ay, az = load3(ball, frames, n, there)
        apart = radius + tl.load(ball + 3 * frames + n, mask=there, other=0.0)
        there = there & (dot(qx - ax, qy - ay, qz - az, qx - ax, qy - ay, qz - az) <= apart * apart)
        if tl.max(there.to(tl.int32), axis=0) > 0:
            i, j, k = tl.load(faces + 3 * face), tl.load(faces + 3 * face + 1), tl.load(faces + 3 * face + 2)
            ax, ay, az = load3(points + i * 3 * frames, frames, n, there)
            bx, by, bz = load3(points + j * 3 * frames, frames, n, there)
            cx, cy, cz = load3(points + k * 3 * frames, frames, n, there)
            bx, by, bz, cx, cy, cz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
            px, py, pz = qx - ax, qy - ay, qz - az
            s, t, _ = _closest_alone(px, py, pz, bx, by, bz, cx, cy, cz)
            px, py, pz = px - s * bx - t * cx, py - s * by - t * cy, pz - s * bz - t * cz
            r = tl.maximum(tl.sqrt(dot(px, py, pz, px, py, pz)), TINY)
            px, py, pz = px / r, py / r, pz / r
            closer = there & (r < best)
            shrink = tl.exp2(exponent * tl.log2(tl.where(closer, r / best, 1.0)))
            weight = tl.exp2(exponent * tl.log2(tl.where(closer, 1.0, best / r)))
            weight = tl.where(there, weight, 0.0)
            best = tl.where(closer, r, best)
            i_best, j_best = tl.where(closer, i, i_best), tl.where(closer, j, j_best)
            k_best = tl.where(closer, k, k_best)
            s_best, t_best = tl.where(closer, s, s_best), tl.where(closer, t, t_best)
            wx, wy, wz = tl.where(closer, px, wx), tl.where(closer, py, wy), tl.where(closer, pz, wz)
            total = total * shrink + weight
            hx, hy, hz = hx * shrink + weight * px, hy * shrink + weight * py, hz * shrink + weight * pz
            xx, xy = xx * shrink + weight * px * px, xy * shrink + weight * px * py
            xz, yy = xz * shrink + weight * px * pz, yy * shrink + weight * py * py
            yz, zz = yz * shrink + weight * py * pz, zz * shrink + weight * pz * pz
            weight = weight / r
            gx, gy, gz = gx * shrink + weight * px, gy * shrink + weight * py, gz * shrink + weight * pz
    found = near & (best < reach)
    total = tl.where(found, total, 1.0)
    distance = best * tl.exp2(-tl.log2(total) / exponent)
    hx, hy, hz = hx / total, hy / total, hz / total
    scale = (exponent + 1) / tl.maximum(distance, TINY)
    xx, xy, xz = (xx / total - hx * hx) * scale, (xy / total - hx * hy) * scale, (xz / total - hx * hz) * scale
    yy, yz, zz = (yy / total - hy * hy) * scale, (yz / total - hy * hz) * scale, (zz / total - hz * hz) * scale
    scale = distance / total
    gx, gy, gz = gx * scale, gy * scale, gz * scale

    nx, ny, nz = _mixed(normals, frames, i_best, j_best, k_best, s_best, t_best, n, inside, inside)
    length = tl.maximum(tl.sqrt(dot(nx, ny, nz, nx, ny, nz)), 1e-8)
    nx, ny, nz = nx / length, ny / length, nz / length
    within = found & (dot(wx, wy, wz, nx, ny, nz) < -deep_cosine * tl.minimum(best / max_distance, 1.0))
    sign = tl.where(within, -1.0, 1.0)
    touches = found & (best <= surface_epsilon)
    gx, gy, gz = tl.where(touches, nx, sign * gx), tl.where(touches, ny, sign * gy), tl.where(touches, nz, sign * gz)
    distance = sign * tl.where(touches, best, distance)
    gx, gy, gz = tl.where(found, gx, mx), tl.where(found, gy, my), tl.where(found, gz, mz)
    far_off = dot(mx, my, mz, qx - ox, qy - oy, qz - oz)
    store3(normal + v * 3 * frames, frames, n, inside, gx, gy, gz)
    tl.store(distances + v * frames + n, tl.where(found, distance, far_off), mask=inside)

    # Inside, the nearest edge or corner: (1 - u u' - e e') / r.
    ex, ey, ez, bends = _edge(points, frames, i_best, j_best, k_best, s_best, t_best, edge_epsilon, n, inside)
    scale = tl.where(bends, 1.0, 0.0) / best
    use, out = found & ~touches, curvature + v * 9 * frames
    xx = tl.where(use, tl.where(within, (1 - wx * wx - ex * ex) * scale, xx), 0.0)
    yy = tl.where(use, tl.where(within, (1 - wy * wy - ey * ey) * scale, yy), 0.0)
    zz = tl.where(use, tl.where(within, (1 - wz * wz - ez * ez) * scale, zz), 0.0)
    xy = tl.where(use, tl.where(within, (-wx * wy - ex * ey) * scale, xy), 0.0)
    xz = tl.where(use, tl.where(within, (-wx * wz - ex * ez) * scale, xz), 0.0)
    yz = tl.where(use, tl.where(within, (-wy * wz - ey * ez) * scale, yz), 0.0)
    store3(out, frames, n, inside, xx, xy, xz)
    store3(out + 3 * frames, frames, n, inside, xy, yy, yz)
    store3(out + 6 * frames, frames, n, inside, xz, yz, zz)


@triton.jit
def _edge(points, frames, i, j, k, s, t, edge_epsilon, n, inside):
    """Direction of the edge that a point lies on, else zero, and whether it lies on an edge or corner."""
    none_i, none_j, none_k = 1 - s - t <= edge_epsilon, s <= edge_epsilon, t <= edge_epsilon
    many = none_i.to(tl.int32) + none_j.to(tl.int32) + none_k.to(tl.int32)
    start = tl.where(none_i, j, tl.where(none_j, k, i))
    stop = tl.where(none_i, k, tl.where(none_j, i, j))
    ax, ay, az = load3(points + start * 3 * frames, frames, n, inside)
    bx, by, bz = load3(points + stop * 3 * frames, frames, n, inside)
    ex, ey, ez = bx - ax, by - ay, bz - az
    one = tl.where(many == 1, 1.0, 0.0) / tl.maximum(tl.sqrt(dot(ex, ey, ez, ex, ey, ez)), TINY)
    return ex * one, ey * one, ez * one, many > 0
