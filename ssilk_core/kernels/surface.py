# SPDX-License-Identifier: Apache-2.0
"""The nearest point on the triangles around the nearest body vertex; `energy.surface_point` holds the plain twin.

A program owns one frame and a block of garment vertices, laid out as (frames, coordinates, vertices).
"""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

BLOCK = 128  # garment vertices of one program


def surface_kernel(x: Tensor, index: Tensor, points: Tensor, normals: Tensor, rings: Tensor) -> tuple[Tensor, Tensor]:
    """Return unit normals (V, 3, N) and offsets n . b (V, N) of the nearest surface points.

    Args:
        x: queries (V, 3, N); index: their nearest body vertices (V, N).
        points, normals: of the body (B, 3, N); rings: other corners around each vertex (B, D, 2).
    """
    vertices, _, frames = x.shape
    by_frame = [values.permute(2, 1, 0).contiguous() for values in (x, points, normals)]
    normal, offset = x.new_empty(frames, 3, vertices), x.new_empty(frames, vertices)
    grid = (frames, -(-vertices // BLOCK))
    _surface[grid](
        *by_frame,
        index.T.contiguous(),
        rings.int().contiguous(),
        normal,
        offset,
        vertices,
        len(points),
        rings.shape[1],
        BLOCK,
    )
    return normal.permute(2, 1, 0).contiguous(), offset.T.contiguous()


@triton.jit
def _surface(x, points, normals, index, rings, normal, offset, vertices, body, degree, block: tl.constexpr):
    frame = tl.program_id(0).to(tl.int64)
    v = tl.program_id(1) * block + tl.arange(0, block)
    inside = v < vertices
    query = x + frame * 3 * vertices + v
    first = tl.load(index + frame * vertices + v, mask=inside, other=0)
    base = points + frame * 3 * body
    ox, oy, oz = tl.load(base + first), tl.load(base + body + first), tl.load(base + 2 * body + first)
    px = tl.load(query, mask=inside, other=0.0) - ox
    py = tl.load(query + vertices, mask=inside, other=0.0) - oy
    pz = tl.load(query + 2 * vertices, mask=inside, other=0.0) - oz
    best = tl.zeros((block,), tl.float32)
    s_best, t_best = tl.zeros((block,), tl.float32), tl.zeros((block,), tl.float32)
    j_best, k_best = first, first
    for d in range(degree):
        j = tl.load(rings + (first * degree + d) * 2).to(tl.int64)
        k = tl.load(rings + (first * degree + d) * 2 + 1).to(tl.int64)
        ux, uy, uz = tl.load(base + j) - ox, tl.load(base + body + j) - oy, tl.load(base + 2 * body + j) - oz
        wx, wy, wz = tl.load(base + k) - ox, tl.load(base + body + k) - oy, tl.load(base + 2 * body + k) - oz
        d1, d2 = ux * px + uy * py + uz * pz, wx * px + wy * py + wz * pz
        a, b, c = ux * ux + uy * uy + uz * uz, ux * wx + uy * wy + uz * wz, wx * wx + wy * wy + wz * wz
        determinant = tl.maximum(a * c - b * b, 1e-30)
        s, t = (c * d1 - b * d2) / determinant, (a * d2 - b * d1) / determinant
        within = (s >= 0) & (t >= 0) & (s + t <= 1)
        # The three edges, each clamped to its ends; the inside wins where it is feasible.
        s1 = tl.minimum(tl.maximum(d1 / tl.maximum(a, 1e-30), 0.0), 1.0)
        t2 = tl.minimum(tl.maximum(d2 / tl.maximum(c, 1e-30), 0.0), 1.0)
        t3 = tl.minimum(tl.maximum((d2 - d1 - b + a) / tl.maximum(a - 2 * b + c, 1e-30), 0.0), 1.0)
        s3 = 1 - t3
        e1, e2 = s1 * (s1 * a - 2 * d1), t2 * (t2 * c - 2 * d2)
        e3 = s3 * (s3 * a - 2 * d1) + t3 * (t3 * c - 2 * d2) + 2 * s3 * t3 * b
        s_edge, t_edge, e = tl.where(e1 < e2, s1, 0.0), tl.where(e1 < e2, 0.0, t2), tl.minimum(e1, e2)
        s_edge, t_edge, e = tl.where(e3 < e, s3, s_edge), tl.where(e3 < e, t3, t_edge), tl.minimum(e, e3)
        e = tl.where(within, s * (s * a - 2 * d1) + t * (t * c - 2 * d2) + 2 * s * t * b, e)
        s, t = tl.where(within, s, s_edge), tl.where(within, t, t_edge)
        closer = e < best
        best = tl.where(closer, e, best)
        s_best, t_best = tl.where(closer, s, s_best), tl.where(closer, t, t_best)
        j_best, k_best = tl.where(closer, j, j_best), tl.where(closer, k, k_best)
    r_best = 1 - s_best - t_best
    n = normals + frame * 3 * body
    nx = r_best * tl.load(n + first) + s_best * tl.load(n + j_best) + t_best * tl.load(n + k_best)
    n += body
    ny = r_best * tl.load(n + first) + s_best * tl.load(n + j_best) + t_best * tl.load(n + k_best)
    n += body
    nz = r_best * tl.load(n + first) + s_best * tl.load(n + j_best) + t_best * tl.load(n + k_best)
    length = tl.maximum(tl.sqrt(nx * nx + ny * ny + nz * nz), 1e-8)
    nx, ny, nz = nx / length, ny / length, nz / length
    bx = ox + s_best * (tl.load(base + j_best) - ox) + t_best * (tl.load(base + k_best) - ox)
    by = oy + s_best * (tl.load(base + body + j_best) - oy) + t_best * (tl.load(base + body + k_best) - oy)
    bz = oz + s_best * (tl.load(base + 2 * body + j_best) - oz) + t_best * (tl.load(base + 2 * body + k_best) - oz)
    out = normal + frame * 3 * vertices + v
    tl.store(out, nx, mask=inside)
    tl.store(out + vertices, ny, mask=inside)
    tl.store(out + 2 * vertices, nz, mask=inside)
    tl.store(offset + frame * vertices + v, nx * bx + ny * by + nz * bz, mask=inside)
