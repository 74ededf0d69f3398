# SPDX-License-Identifier: Apache-2.0
"""The exact nearest body vertex; reference: `collision.nearest_vertex`.

Vertices of the garment come in compact blocks and those of the body in compact groups, each with its bounding box in
every frame. A program owns one frame and a few blocks. For one block it first visits the group nearest to its centre,
which bounds the distances. It then visits only the groups whose boxes are no further from the block's box than this
bound. Of equally near vertices the first in the table of groups counts, so that results are deterministic.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

FRAMES = 32  # frames that a program of `_pack` transposes
CHUNK = 64  # groups whose boxes are compared with a block's at once
RUN = 4  # blocks that a program of `_search_vertices` processes in turn, so that boxes stay in its cache
# Bounds the relative rounding error of a gap, so that rounding skips no group.
SAFE = tl.constexpr(1 - 1e-5)


def nearest_vertex_kernel(x: Tensor, points: Tensor, blocks: Tensor, groups: Tensor) -> Tensor:
    """Return the index of the nearest body vertex, int32 of shape (V, N).

    Args:
        x, points: garment (V, 3, N) and body (B, 3, N), float32.
        blocks, groups: their vertices in compact blocks (`collision.nearest_vertex.compact_blocks`), int32, as powers
            of two.
    """
    vertices, _, frames = x.shape
    found = torch.empty(vertices, frames, dtype=torch.int32, device=x.device)
    garment, body = by_frame(x, blocks), by_frame(points, groups)
    grid = (frames, triton.cdiv(len(blocks), RUN))
    _search_vertices[grid](*garment, *body, blocks, groups, found, frames, len(blocks), len(groups), blocks.shape[1],
                  groups.shape[1], CHUNK, RUN, num_warps=1)  # fmt: skip
    return found


def by_frame(points: Tensor, table: Tensor) -> tuple[Tensor, Tensor]:
    """Return points (P, 3, N) as (N, 3, rows * size) in the order of a table (rows, size), and boxes (N, 6, rows)."""
    frames, (rows, size) = points.shape[2], table.shape
    packed = points.new_empty(frames, 3, rows * size)
    boxes = points.new_empty(frames, 6, rows)
    grid = (rows, triton.cdiv(frames, FRAMES))
    _pack[grid](points.contiguous(), table, packed, boxes, frames, rows, size, FRAMES, num_warps=1)
    return packed, boxes


@triton.jit
def _pack(points, table, packed, boxes, frames, rows, size: tl.constexpr, block_n: tl.constexpr):
    row = tl.program_id(0)
    frame = tl.program_id(1).to(tl.int64) * block_n + tl.arange(0, block_n)
    inside = frame < frames
    slot = row * size + tl.arange(0, size)
    point = tl.load(table + slot).to(tl.int64)
    for axis in tl.static_range(3):
        source = points + (point[None, :] * 3 + axis) * frames + frame[:, None]
        value = tl.load(source, mask=inside[:, None], other=0.0)
        tl.store(packed + (frame[:, None] * 3 + axis) * rows * size + slot[None, :], value, mask=inside[:, None])
        box = boxes + (frame * 6 + axis) * rows + row
        tl.store(box, tl.min(value, axis=1), mask=inside)
        tl.store(box + 3 * rows, tl.max(value, axis=1), mask=inside)


@triton.jit
def _search_vertices(garment, garment_boxes, body, body_boxes, blocks, groups, found, frames, block_count,
                     group_count, block_v: tl.constexpr, block_b: tl.constexpr, chunk: tl.constexpr,
                     run: tl.constexpr):  # fmt: skip
    frame = tl.program_id(0).to(tl.int64)
    first = tl.program_id(1) * run
    garment += frame * 3 * block_count * block_v
    garment_boxes += frame * 6 * block_count
    body += frame * 3 * group_count * block_b
    body_boxes += frame * 6 * group_count
    for block in range(first, min(first + run, block_count)):
        v = block * block_v + tl.arange(0, block_v)
        x, y, z = _three(garment + v, block_count * block_v)
        lx, ly, lz = _three(garment_boxes + block, block_count)
        hx, hy, hz = _three(garment_boxes + 3 * block_count + block, block_count)
        seed = _group_at(body_boxes, group_count, (lx + hx) / 2, (ly + hy) / 2, (lz + hz) / 2, chunk)
        bound = tl.max(tl.min(_squares(x, y, z, body, seed, group_count, block_b), axis=1), axis=0)
        best = tl.full((block_v, block_b), float("inf"), tl.float32)
        owner = tl.zeros((block_v, block_b), tl.int32)
        for start in range(0, group_count, chunk):
            group = start + tl.arange(0, chunk)
            gap = _gaps(body_boxes, group, group_count, lx, ly, lz, hx, hy, hz)
            # Written so that NaN skips no group.
            near = ~(gap * SAFE > bound)
            g = tl.min(tl.where(near, group, group_count), axis=0)
            while g < group_count:
                square = _squares(x, y, z, body, g, group_count, block_b)
                closer = square < best
                best = tl.where(closer, square, best)
                owner = tl.where(closer, g, owner)
                g = tl.min(tl.where(near & (group > g), group, group_count), axis=0)
        place = owner * block_b + tl.arange(0, block_b)[None, :]
        least = tl.min(best, axis=1)
        winner = tl.min(tl.where(best == least[:, None], place, 2147483647), axis=1)
        target = found + tl.load(blocks + v).to(tl.int64) * frames + frame
        tl.store(target, tl.load(groups + winner))  # padding of a block writes the same value again


@triton.jit
def _three(point, stride):
    return tl.load(point), tl.load(point + stride), tl.load(point + 2 * stride)


@triton.jit
def _squares(x, y, z, body, group, group_count, block_b: tl.constexpr):
    """Squared distances of a block of vertices to one group, shape (block_v, block_b)."""
    bx, by, bz = _three(body + group * block_b + tl.arange(0, block_b), group_count * block_b)
    dx, dy, dz = x[:, None] - bx[None, :], y[:, None] - by[None, :], z[:, None] - bz[None, :]
    return dx * dx + dy * dy + dz * dz


@triton.jit
def _gaps(boxes, group, count, lx, ly, lz, hx, hy, hz):
    """Squared distances from one box to those of a chunk of groups."""
    here = group < count
    low, high = boxes + group, boxes + 3 * count + group
    dx = _apart(low, high, here, lx, hx)
    dy = _apart(low + count, high + count, here, ly, hy)
    dz = _apart(low + 2 * count, high + 2 * count, here, lz, hz)
    return dx * dx + dy * dy + dz * dz


@triton.jit
def _apart(low, high, here, lower, upper):
    """Distances along one axis from the interval [lower, upper] to others, zero where they meet."""
    low, high = tl.load(low, mask=here, other=0.0), tl.load(high, mask=here, other=0.0)
    return tl.maximum(tl.maximum(low - upper, lower - high), 0.0)


@triton.jit
def _group_at(boxes, count, x, y, z, chunk: tl.constexpr):
    """The group whose box is nearest to a point."""
    least = tl.full((chunk,), float("inf"), tl.float32)
    nearest = tl.zeros((chunk,), tl.int32)
    for start in range(0, count, chunk):
        group = start + tl.arange(0, chunk)
        gap = _gaps(boxes, group, count, x, y, z, x, y, z)
        closer = (gap < least) & (group < count)
        least = tl.where(closer, gap, least)
        nearest = tl.where(closer, group, nearest)
    return tl.min(tl.where(least == tl.min(least, axis=0), nearest, 2147483647), axis=0)
