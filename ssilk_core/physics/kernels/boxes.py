# SPDX-License-Identifier: Apache-2.0
"""Distances to rounded boxes; reference: `training.obstacles.Obstacles`.

A program owns a run of points in a block of frames, and tests all boxes of these frames. Numbers of the boxes lie
with frames last, so that consecutive ones are contiguous in memory.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from .vectors import dot, load3, store3

FRAMES = 32  # of one program
POINTS = 16  # of one program, one after the other
NUMBERS = tl.constexpr(16)  # of a box: its axes as rows of the matrix, its centre, half extents and radius
TINY = tl.constexpr(1e-9)
FAR = tl.constexpr(1e30)

Boxes = tuple[Tensor, Tensor, Tensor, Tensor]


def nearest_box_kernel(points: Tensor, boxes: Boxes) -> tuple[Tensor, Tensor]:
    """Return distances of points (M, 3, N) to the nearest of K boxes [m], (M, N), and directions away, (M, 3, N).

    Args:
        boxes: `Obstacles.parts`: axes (K, N, 3, 3), centres and half extents (K, N, 3), and radii (K, N).
    """
    points = points.contiguous()
    count, _, frames = points.shape
    distance, away = points.new_empty(count, frames), torch.empty_like(points)
    _launch(points, boxes, distance, away, 0.0, False)
    return distance, away


def nearer_planes_kernel(points: Tensor, boxes: Boxes, normal: Tensor, offset: Tensor, clearance: float) -> None:
    """Replace, in place, the plane of each point by that of the nearest box where this is nearer; then move all
    planes outwards.

    Args:
        points: (M, 3, N); boxes: as above.
        normal: (M, 3, N), and offset: (M, N) [m].
        clearance: by which planes are moved [m].
    """
    assert normal.is_contiguous() and offset.is_contiguous()
    _launch(points.contiguous(), boxes, offset, normal, clearance, True)


def box_clearance_kernel(points: Tensor, boxes: Boxes) -> Tensor:
    """Return the least distance of points (M, 3, N) to each of K boxes [m], (K, N)."""
    points = points.contiguous()
    frames, least = points.shape[2], torch.empty_like(boxes[3])
    grid = (len(least), triton.cdiv(frames, FRAMES))
    _box_clearance[grid](points, _packed(boxes), least, len(points), frames, FRAMES, num_warps=1)
    return least


def _packed(boxes: Boxes) -> Tensor:
    """Return the numbers of boxes (K, 16, N)."""
    turn, centre, half, radius = boxes
    return torch.cat([turn.flatten(2), centre, half, radius[..., None]], dim=2).transpose(1, 2).contiguous()


def _launch(points: Tensor, boxes: Boxes, distance: Tensor, away: Tensor, clearance: float, replaces: bool) -> None:
    count, _, frames = points.shape
    grid = (triton.cdiv(count, POINTS), triton.cdiv(frames, FRAMES))
    _nearest_box[grid](points, _packed(boxes), distance, away, clearance, count, frames, len(boxes[3]), replaces,
                       POINTS, FRAMES, num_warps=1)  # fmt: skip


@triton.jit
def _outside(px, py, pz, box, frames, n, inside):
    """Points in a box's axes, and by how much they are outside of its faces."""
    cx, cy, cz = load3(box + 9 * frames, frames, n, inside)
    px, py, pz = px - cx, py - cy, pz - cz
    ax, ay, az = load3(box, frames, n, inside)
    bx, by, bz = load3(box + 3 * frames, frames, n, inside)
    cx, cy, cz = load3(box + 6 * frames, frames, n, inside)
    lx, ly, lz = dot(px, py, pz, ax, bx, cx), dot(px, py, pz, ay, by, cy), dot(px, py, pz, az, bz, cz)
    hx, hy, hz = load3(box + 12 * frames, frames, n, inside)
    return lx, ly, lz, tl.abs(lx) - hx, tl.abs(ly) - hy, tl.abs(lz) - hz


@triton.jit
def _signed(ox, oy, oz, box, frames, n, inside):
    """Distances, lengths outside of the box without its radius, and the depth of the nearest face."""
    ux, uy, uz = tl.maximum(ox, 0.0), tl.maximum(oy, 0.0), tl.maximum(oz, 0.0)
    length, deepest = tl.sqrt(dot(ux, uy, uz, ux, uy, uz)), tl.maximum(tl.maximum(ox, oy), oz)
    radius = tl.load(box + 15 * frames + n, mask=inside, other=0.0)
    return length + tl.minimum(deepest, 0.0) - radius, length, deepest


@triton.jit
def _nearest_box(points, boxes, distances, aways, clearance, count, frames, box_count: tl.constexpr,
             replaces: tl.constexpr, run: tl.constexpr, block: tl.constexpr):  # fmt: skip
    first = tl.program_id(0).to(tl.int64) * run
    n = tl.program_id(1) * block + tl.arange(0, block)
    inside = n < frames
    for m in range(first, tl.minimum(first + run, count)):
        px, py, pz = load3(points + m * 3 * frames, frames, n, inside)
        best = tl.zeros_like(px) + FAR
        ax, ay, az = tl.zeros_like(px), tl.zeros_like(px), tl.zeros_like(px)
        for k in tl.static_range(box_count):
            box = boxes + k * NUMBERS * frames
            lx, ly, lz, ox, oy, oz = _outside(px, py, pz, box, frames, n, inside)
            distance, length, deepest = _signed(ox, oy, oz, box, frames, n, inside)
            # Inside, the nearest face is that which is least deep.
            beyond = length > TINY
            ux = tl.where(beyond, tl.maximum(ox, 0.0), tl.where(ox == deepest, 1.0, 0.0))
            uy = tl.where(beyond, tl.maximum(oy, 0.0), tl.where(oy == deepest, 1.0, 0.0))
            uz = tl.where(beyond, tl.maximum(oz, 0.0), tl.where(oz == deepest, 1.0, 0.0))
            size = tl.maximum(tl.sqrt(dot(ux, uy, uz, ux, uy, uz)), TINY)
            ux, uy, uz = ux / size, uy / size, uz / size
            ux, uy, uz = tl.where(lx < 0, -ux, ux), tl.where(ly < 0, -uy, uy), tl.where(lz < 0, -uz, uz)
            wx = dot(ux, uy, uz, *load3(box, frames, n, inside))
            wy = dot(ux, uy, uz, *load3(box + 3 * frames, frames, n, inside))
            wz = dot(ux, uy, uz, *load3(box + 6 * frames, frames, n, inside))
            nearer = distance < best
            best = tl.where(nearer, distance, best)
            ax, ay, az = tl.where(nearer, wx, ax), tl.where(nearer, wy, ay), tl.where(nearer, wz, az)
        if replaces:
            x, y, z = load3(aways + m * 3 * frames, frames, n, inside)
            offset = tl.load(distances + m * frames + n, mask=inside, other=0.0)
            nearer = inside & (best < dot(x, y, z, px, py, pz) - offset)
            offset = tl.where(nearer, dot(ax, ay, az, px, py, pz) - best, offset)
            tl.store(distances + m * frames + n, offset + clearance, mask=inside)
            store3(aways + m * 3 * frames, frames, n, nearer, ax, ay, az)
        else:
            tl.store(distances + m * frames + n, best, mask=inside)
            store3(aways + m * 3 * frames, frames, n, inside, ax, ay, az)


@triton.jit
def _box_clearance(points, boxes, found, count, frames, block: tl.constexpr):
    k = tl.program_id(0).to(tl.int64)
    n = tl.program_id(1) * block + tl.arange(0, block)
    inside = n < frames
    box = boxes + k * NUMBERS * frames
    least = tl.zeros((block,), tl.float32) + FAR
    for _point in range(count):
        px, py, pz = load3(points, frames, n, inside)
        _, _, _, ox, oy, oz = _outside(px, py, pz, box, frames, n, inside)
        distance, _, _ = _signed(ox, oy, oz, box, frames, n, inside)
        least = tl.minimum(least, distance)
        points += 3 * frames
    tl.store(found + k * frames + n, least, mask=inside)
