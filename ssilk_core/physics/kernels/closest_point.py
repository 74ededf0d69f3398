# SPDX-License-Identifier: Apache-2.0
"""The tangent plane at the nearest point of a body's whole surface; reference: `collision.closest_point`.

As in `nearest_vertex`, vertices of the garment come in compact blocks with bounding boxes, a program owns one frame
and a few blocks, and body groups whose boxes are out of reach are skipped. A group is a patch of triangles here, and
the distance to the nearest body vertex bounds the search.
"""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from .nearest_vertex import CHUNK, RUN, SAFE, _gaps, _three, by_frame
from .one_ring import _closest_alone
from .vectors import dot

LANES = tl.constexpr(8)  # triangles of a patch; their corners are four rows of a table, the last of them padding
WARPS = 2


def closest_point_kernel(
    x: Tensor,
    index: Tensor,
    points: Tensor,
    normals: Tensor,
    blocks: Tensor,
    patches: Tensor,
    max_distance: float,
    max_depth: float,
    deep_cosine: float,
    surface_epsilon: float,
) -> tuple[Tensor, Tensor]:
    """Return unit normals (V, 3, N) and offsets n . b (V, N) of the nearest body points b, as `nearest_planes` does.

    Args:
        x: queries (V, 3, N); index: their nearest body vertices (V, N), int32.
        points, normals: of the body (B, 3, N).
        blocks: the queries in compact blocks (`collision.nearest_vertex.compact_blocks`), int32.
        patches: corners of triangles in compact patches (`collision.closest_point.triangle_patches`), int32.
        max_distance, max_depth: queries further than the first from their nearest vertex [m] use it as the nearest
            point, and the direction from there; unless they lie behind its tangent plane, and within the second.
        deep_cosine: see `collision.distance.DEEP_COSINE`.
        surface_epsilon: queries nearer than this to their nearest point [m] use the interpolated normal.
    """
    vertices, _, frames = x.shape
    points, normals = points.contiguous(), normals.contiguous()
    normal, offset = x.new_empty(vertices, 3, frames), x.new_empty(vertices, frames)
    garment, body = by_frame(x, blocks), by_frame(points, patches)
    grid = (frames, triton.cdiv(len(blocks), RUN))
    _search_surface[grid](*garment, *body, blocks, patches, index, points, normals, normal, offset, frames,
                          len(blocks), len(patches), max_distance * max_distance, max_depth * max_depth,
                          max_distance, deep_cosine, surface_epsilon, blocks.shape[1], CHUNK, RUN,
                          num_warps=WARPS)  # fmt: skip
    return normal, offset


@triton.jit
def _search_surface(garment, garment_boxes, body, body_boxes, blocks, patches, index, points, normals, normal, offset,
            frames, block_count, patch_count, max_square, deepest, max_distance, deep_cosine, surface_epsilon,
            block_v: tl.constexpr, chunk: tl.constexpr, run: tl.constexpr):  # fmt: skip
    frame = tl.program_id(0).to(tl.int64)
    garment += frame * 3 * block_count * block_v
    garment_boxes += frame * 6 * block_count
    body += frame * 3 * patch_count * 4 * LANES
    body_boxes += frame * 6 * patch_count
    for block in range(tl.program_id(1) * run, min(tl.program_id(1) * run + run, block_count)):
        v = block * block_v + tl.arange(0, block_v)
        vertex = tl.load(blocks + v).to(tl.int64)
        x, y, z = _three(garment + v, block_count * block_v)
        first = tl.load(index + vertex * frames + frame).to(tl.int64)
        ox, oy, oz = _three(points + first * 3 * frames + frame, frames)
        square = dot(x - ox, y - oy, z - oz, x - ox, y - oy, z - oz)
        mx, my, mz = _three(normals + first * 3 * frames + frame, frames)
        behind = dot(mx, my, mz, x - ox, y - oy, z - oz) < 0
        near = (square < max_square) | (behind & (square < deepest))
        bound = tl.max(tl.where(near, square, 0.0), axis=0)
        winner, s, t, least = _nearest(x, y, z, garment_boxes + block, block_count, body, body_boxes, patch_count,
                                       bound, block_v, chunk)  # fmt: skip
        near = near & (least < float("inf"))
        corner = patches + winner // LANES * 4 * LANES + winner % LANES
        i = tl.where(near, tl.load(corner), first)
        j = tl.where(near, tl.load(corner + LANES), first)
        k = tl.where(near, tl.load(corner + 2 * LANES), first)
        s, t = tl.where(near, s, 0.0), tl.where(near, t, 0.0)
        bx, by, bz = _mixed(points + frame, frames, i, j, k, s, t)
        nx, ny, nz = _mixed(normals + frame, frames, i, j, k, s, t)
        length = tl.maximum(tl.sqrt(dot(nx, ny, nz, nx, ny, nz)), 1e-8)
        nx, ny, nz = nx / length, ny / length, nz / length
        ax, ay, az = x - bx, y - by, z - bz
        away = tl.sqrt(dot(ax, ay, az, ax, ay, az))
        level = -deep_cosine * away * tl.minimum(away / max_distance, 1.0)
        side = tl.where(near & (dot(ax, ay, az, nx, ny, nz) < level), -1.0, 1.0) / tl.maximum(away, surface_epsilon)
        outward = away > surface_epsilon
        nx, ny, nz = (
            tl.where(outward, side * ax, nx),
            tl.where(outward, side * ay, ny),
            tl.where(outward, side * az, nz),
        )
        target = normal + vertex * 3 * frames + frame
        tl.store(target, nx)  # padding of a block writes the same value again
        tl.store(target + frames, ny)
        tl.store(target + 2 * frames, nz)
        tl.store(offset + vertex * frames + frame, dot(nx, ny, nz, bx, by, bz))


@triton.jit
def _nearest(x, y, z, box, block_count, body, body_boxes, patch_count, bound, block_v: tl.constexpr,
             chunk: tl.constexpr):  # fmt: skip
    """For each vertex of a block: the nearest triangle within reach, the nearest point and its squared distance."""
    lx, ly, lz = _three(box, block_count)
    hx, hy, hz = _three(box + 3 * block_count, block_count)
    lane = tl.arange(0, LANES)[None, :]
    best = tl.full((block_v, LANES), float("inf"), tl.float32)
    s_best, t_best = tl.zeros((block_v, LANES), tl.float32), tl.zeros((block_v, LANES), tl.float32)
    owner = tl.zeros((block_v, LANES), tl.int32)
    for start in range(0, patch_count, chunk):
        patch = start + tl.arange(0, chunk)
        gap = _gaps(body_boxes, patch, patch_count, lx, ly, lz, hx, hy, hz)
        near = ~(gap * SAFE > bound)
        g = tl.min(tl.where(near, patch, patch_count), axis=0)
        while g < patch_count:
            s, t, square = _on_patch(x, y, z, body + g * 4 * LANES + lane, patch_count * 4 * LANES)
            closer = square < best
            best, owner = tl.where(closer, square, best), tl.where(closer, g, owner)
            s_best, t_best = tl.where(closer, s, s_best), tl.where(closer, t, t_best)
            g = tl.min(tl.where(near & (patch > g), patch, patch_count), axis=0)
    place = owner * LANES + lane
    least = tl.min(best, axis=1)
    winner = tl.min(tl.where(best == least[:, None], place, 2147483647), axis=1)
    chosen = (place == winner[:, None]) & (best == least[:, None])
    s, t = tl.sum(tl.where(chosen, s_best, 0.0), axis=1), tl.sum(tl.where(chosen, t_best, 0.0), axis=1)
    return winner, s, t, least


@triton.jit
def _on_patch(x, y, z, corner, stride):
    """Nearest points on the triangles of a patch to a block of vertices: s, t and squared distances."""
    ax, ay, az = _three(corner, stride)
    ux, uy, uz = _three(corner + LANES, stride)
    wx, wy, wz = _three(corner + 2 * LANES, stride)
    px, py, pz = x[:, None] - ax, y[:, None] - ay, z[:, None] - az
    ux, uy, uz, wx, wy, wz = ux - ax, uy - ay, uz - az, wx - ax, wy - ay, wz - az
    s, t, e = _closest_alone(px, py, pz, ux, uy, uz, wx, wy, wz)
    return s, t, dot(px, py, pz, px, py, pz) + e


@triton.jit
def _mixed(values, frames, i, j, k, s, t):
    """(1 - s - t) of vertex i, s of j and t of k."""
    ix, iy, iz = _three(values + i * 3 * frames, frames)
    jx, jy, jz = _three(values + j * 3 * frames, frames)
    kx, ky, kz = _three(values + k * 3 * frames, frames)
    r = 1 - s - t
    return r * ix + s * jx + t * kx, r * iy + s * jy + t * ky, r * iz + s * jz + t * kz
