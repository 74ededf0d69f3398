# SPDX-License-Identifier: Apache-2.0
"""Lengths of intersection contours, and their gradients; reference: `intersections.contours`.

Triangles lie in tiles of `TILE`. A program of the search owns a tile in a frame, and writes pairs of its triangles
with those of the same and of later tiles into `SLOTS` places of its own; a pair that finds none is left out. It
compares the boxes of `BOXES` tiles at once, and goes through those that meet its own. Sums are of whole numbers,
which are the same in any order: results are deterministic.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from .vectors import cross, dot

TILE, SLOTS = 16, 128
BOXES = tl.constexpr(32)
PAIRS = tl.constexpr(32)  # measured at once
WARPS = 1
STEPS = tl.constexpr(float(1 << 32))  # of a newton
TINY = tl.constexpr(1e-30)


def contours_kernel(
    x: Tensor, faces: Tensor, places: Tensor, moves: Tensor, allowed: Tensor, steepest: float
) -> tuple[Tensor, Tensor]:
    """Return the length of all contours in each frame [m], (N,), and its gradient (V, 3, N).

    Args:
        x: positions (V, 3, N), float32.
        faces: corners of the triangles, in an order in which near ones are neighbours, int32 (F, 3).
        places: corners of the triangles, one of coincident vertices for all, int32 (F, 3).
        moves: whether each triangle may meet others that do not move, int32 (F,).
        allowed: ascending first * F + second of the pairs that do not count, int64 (A,), at least one.
        steepest: see `intersections.contours`.
    """
    vertices, _, frames = x.shape
    count = len(faces)
    tiles = triton.cdiv(count, TILE)
    points = x.permute(2, 0, 1).contiguous()
    corners = points[:, faces.flatten().long()].reshape(frames, count, 3, 3)
    low, high = (
        torch.nn.functional.pad(bounds, (0, 0, 0, tiles * TILE - count), value=empty).transpose(1, 2).contiguous()
        for bounds, empty in ((corners.amin(2), torch.inf), (corners.amax(2), -torch.inf))
    )
    around = low.unflatten(2, (tiles, TILE)).amin(3), high.unflatten(2, (tiles, TILE)).amax(3)
    pairs = torch.empty(frames, tiles, SLOTS, dtype=torch.int64, device=x.device)
    found = torch.empty(frames, tiles, dtype=torch.int32, device=x.device)
    _search_pairs[(tiles, frames)](
        points, low, high, *around, faces, places, moves, pairs, found, vertices, count, tiles, TILE, SLOTS,
        num_warps=WARPS,
    )  # fmt: skip
    lengths = torch.zeros(frames, tiles, device=x.device)
    gradient = torch.zeros(frames, vertices, 3, dtype=torch.int64, device=x.device)
    _measure_contours[(tiles, frames)](
        points, faces, pairs, found, allowed, lengths, gradient, vertices, count, tiles, len(allowed),
        len(allowed).bit_length(), steepest, SLOTS, num_warps=WARPS,
    )  # fmt: skip
    return lengths.sum(1), (gradient.permute(1, 2, 0).double() / STEPS.value).to(x.dtype)


@triton.jit
def _corner(points, vertex, inside):
    base = points + 3 * vertex
    x = tl.load(base, mask=inside, other=0.0)
    y = tl.load(base + 1, mask=inside, other=0.0)
    z = tl.load(base + 2, mask=inside, other=0.0)
    return x, y, z


@triton.jit
def _side(points, vertex, inside, ox, oy, oz, nx, ny, nz):
    """On which side of planes through o vertices lie; one of both is (T, 1), the other (1, T)."""
    x, y, z = _corner(points, vertex, inside)
    return dot(x - ox, y - oy, z - oz, nx, ny, nz)


@triton.jit
def _plane(points, a, b, c, inside):
    ax, ay, az = _corner(points, a, inside)
    bx, by, bz = _corner(points, b, inside)
    cx, cy, cz = _corner(points, c, inside)
    nx, ny, nz = cross(bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az)
    return ax, ay, az, nx, ny, nz


@triton.jit
def _crosses(points, a, b, c, ox, oy, oz, nx, ny, nz, others):
    """Whether corners a, b, c lie on both sides of planes through o."""
    first = _side(points, a, others, ox, oy, oz, nx, ny, nz)
    second = _side(points, b, others, ox, oy, oz, nx, ny, nz)
    third = _side(points, c, others, ox, oy, oz, nx, ny, nz)
    lowest = tl.minimum(tl.minimum(first, second), third)
    return (lowest <= 0) & (tl.maximum(tl.maximum(first, second), third) >= 0)


@triton.jit
def _search_pairs(points, low, high, tile_low, tile_high, faces, places, moves, pairs, found, vertices, count, tiles,
            tile: tl.constexpr, slots: tl.constexpr):  # fmt: skip
    own, frame = tl.program_id(0), tl.program_id(1).to(tl.int64)
    points += frame * vertices * 3
    low, high = low + frame * 3 * tiles * tile, high + frame * 3 * tiles * tile
    tile_low, tile_high = tile_low + frame * 3 * tiles, tile_high + frame * 3 * tiles
    pairs += (frame * tiles + own) * slots
    width = tiles * tile
    i = own * tile + tl.arange(0, tile)
    here = i < count
    ilx, ily, ilz = tl.load(low + i), tl.load(low + width + i), tl.load(low + 2 * width + i)
    ihx, ihy, ihz = tl.load(high + i), tl.load(high + width + i), tl.load(high + 2 * width + i)
    ia, ib, ic = (tl.load(faces + 3 * i, mask=here, other=0), tl.load(faces + 3 * i + 1, mask=here, other=0),
                  tl.load(faces + 3 * i + 2, mask=here, other=0))  # fmt: skip
    ip, iq, ir = (tl.load(places + 3 * i, mask=here, other=0), tl.load(places + 3 * i + 1, mask=here, other=0),
                  tl.load(places + 3 * i + 2, mask=here, other=0))  # fmt: skip
    imoves = tl.load(moves + i, mask=here, other=0)
    lx, ly, lz = (tl.load(tile_low + own), tl.load(tile_low + tiles + own), tl.load(tile_low + 2 * tiles + own))
    hx, hy, hz = (tl.load(tile_high + own), tl.load(tile_high + tiles + own), tl.load(tile_high + 2 * tiles + own))
    total = 0
    box = tl.arange(0, BOXES)
    for first in range(own, tiles, BOXES):
        k = first + box
        last = k < tiles
        meets = last & (tl.load(tile_low + k, mask=last, other=0.0) <= hx)
        meets &= tl.load(tile_high + k, mask=last, other=0.0) >= lx
        meets &= tl.load(tile_low + tiles + k, mask=last, other=0.0) <= hy
        meets &= tl.load(tile_high + tiles + k, mask=last, other=0.0) >= ly
        meets &= tl.load(tile_low + 2 * tiles + k, mask=last, other=0.0) <= hz
        meets &= tl.load(tile_high + 2 * tiles + k, mask=last, other=0.0) >= lz
        left = tl.sum(meets.to(tl.int64) << box, axis=0)  # a bit for each that meets
        while left != 0:
            lowest = left & -left
            left ^= lowest
            other = first + (tl.log2(lowest.to(tl.float32)) + 0.5).to(tl.int32)
            j = other * tile + tl.arange(0, tile)
            there = j < count
            near = (tl.load(low + j)[None, :] <= ihx[:, None]) & (tl.load(high + j)[None, :] >= ilx[:, None])
            near &= tl.load(low + width + j)[None, :] <= ihy[:, None]
            near &= tl.load(high + width + j)[None, :] >= ily[:, None]
            near &= tl.load(low + 2 * width + j)[None, :] <= ihz[:, None]
            near &= tl.load(high + 2 * width + j)[None, :] >= ilz[:, None]
            near &= here[:, None] & there[None, :] & (i[:, None] < j[None, :])
            near &= (imoves[:, None] + tl.load(moves + j, mask=there, other=0)[None, :]) > 0
            for corner in tl.static_range(3):
                place = tl.load(places + 3 * j + corner, mask=there, other=-1)[None, :]
                near &= (ip[:, None] != place) & (iq[:, None] != place) & (ir[:, None] != place)
            if tl.max(tl.max(near.to(tl.int32), axis=1), axis=0) > 0:
                ja = tl.load(faces + 3 * j, mask=there, other=0)[None, :]
                jb = tl.load(faces + 3 * j + 1, mask=there, other=0)[None, :]
                jc = tl.load(faces + 3 * j + 2, mask=there, other=0)[None, :]
                us, them = here[:, None], there[None, :]
                ox, oy, oz, nx, ny, nz = _plane(points, ia[:, None], ib[:, None], ic[:, None], us)
                near &= _crosses(points, ja, jb, jc, ox, oy, oz, nx, ny, nz, them)
                px, py, pz, mx, my, mz = _plane(points, ja, jb, jc, them)
                near &= _crosses(points, ia[:, None], ib[:, None], ic[:, None], px, py, pz, mx, my, mz, us)
                flat = tl.reshape(near, (tile * tile,)).to(tl.int32)
                at = total + tl.cumsum(flat, 0) - 1
                name = i[:, None].to(tl.int64) * count + j[None, :]
                tl.store(pairs + at, tl.reshape(name, (tile * tile,)), mask=(flat > 0) & (at < slots))
                total += tl.sum(flat, 0)
    tl.store(found + frame * tiles + own, tl.minimum(total, slots))


@triton.jit
def _hit(ax, ay, az, bx, by, bz, ox, oy, oz, px, py, pz, qx, qy, qz):
    """Where edge a b crosses triangle o, o + p, o + q: whether, the share of the edge, and of p and q."""
    nx, ny, nz = cross(px, py, pz, qx, qy, qz)
    ax, ay, az, bx, by, bz = ax - ox, ay - oy, az - oz, bx - ox, by - oy, bz - oz
    start, end = dot(ax, ay, az, nx, ny, nz), dot(bx, by, bz, nx, ny, nz)
    through = ((start <= 0) & (end > 0)) | ((start > 0) & (end <= 0))
    t = start / tl.where(through, start - end, 1.0)
    rx, ry, rz = ax + t * (bx - ax), ay + t * (by - ay), az + t * (bz - az)
    square = tl.maximum(dot(nx, ny, nz, nx, ny, nz), TINY)
    ux, uy, uz = cross(rx, ry, rz, qx, qy, qz)
    vx, vy, vz = cross(px, py, pz, rx, ry, rz)
    u, v = dot(ux, uy, uz, nx, ny, nz) / square, dot(vx, vy, vz, nx, ny, nz) / square
    inside = through & (u >= 0) & (v >= 0) & (u + v <= 1)
    return inside, t, u, v, nx, ny, nz, rx + ox, ry + oy, rz + oz


@triton.jit
def _add(gradient, vertex, counts, x, y, z):
    base = gradient + 3 * vertex
    tl.atomic_add(base, (x * STEPS).to(tl.int64), mask=counts)
    tl.atomic_add(base + 1, (y * STEPS).to(tl.int64), mask=counts)
    tl.atomic_add(base + 2, (z * STEPS).to(tl.int64), mask=counts)


@triton.jit
def _edge(points, ia, ib, ja, jb, jc, own):
    """What `_hit` returns of edges ia ib, and the vectors of the edges."""
    ax, ay, az = _corner(points, ia, own)
    bx, by, bz = _corner(points, ib, own)
    ox, oy, oz = _corner(points, ja, own)
    px, py, pz = _corner(points, jb, own)
    qx, qy, qz = _corner(points, jc, own)
    inside, t, u, v, nx, ny, nz, rx, ry, rz = _hit(
        ax, ay, az, bx, by, bz, ox, oy, oz, px - ox, py - oy, pz - oz, qx - ox, qy - oy, qz - oz
    )
    return inside & own, t, u, v, nx, ny, nz, rx, ry, rz, bx - ax, by - ay, bz - az


@triton.jit
def _chosen(edge, ia, ib, ic, ja, jb, jc):
    """The ends of an edge, 0 to 2 of triangle i and 3 to 5 of j, and the corners of the other triangle."""
    of_first = edge < 3
    corner = edge % 3
    a, b, c = tl.where(of_first, ia, ja), tl.where(of_first, ib, jb), tl.where(of_first, ic, jc)
    start = tl.where(corner == 0, a, tl.where(corner == 1, b, c))
    end = tl.where(corner == 0, b, tl.where(corner == 1, c, a))
    return start, end, tl.where(of_first, ja, ia), tl.where(of_first, jb, ib), tl.where(of_first, jc, ic)


@triton.jit
def _measure_contours(points, faces, pairs, found, allowed, lengths, gradient, vertices, count, tiles, allowed_count,
             halvings: tl.constexpr, steepest, slots: tl.constexpr):  # fmt: skip
    own, frame = tl.program_id(0), tl.program_id(1).to(tl.int64)
    place = frame * tiles + own
    total = tl.load(found + place)
    if total == 0:
        return
    points += frame * vertices * 3
    gradient += frame * vertices * 3
    whole = 0.0
    for begin in range(0, total, PAIRS):
        slot = begin + tl.arange(0, PAIRS)
        counts = slot < total
        name = tl.load(pairs + place * slots + slot, mask=counts, other=0)
        low = tl.zeros((PAIRS,), tl.int32)
        high = low + allowed_count
        for _halving in tl.static_range(halvings):
            middle = (low + high) // 2
            less = tl.load(allowed + middle, mask=low < high, other=0) < name
            low, high = tl.where((low < high) & less, middle + 1, low), tl.where((low < high) & ~less, middle, high)
        counts &= tl.load(allowed + low, mask=low < allowed_count, other=-1) != name
        i, j = (name // count).to(tl.int32), (name % count).to(tl.int32)
        ia, ib, ic = tl.load(faces + 3 * i), tl.load(faces + 3 * i + 1), tl.load(faces + 3 * i + 2)
        ja, jb, jc = tl.load(faces + 3 * j), tl.load(faces + 3 * j + 1), tl.load(faces + 3 * j + 2)
        hits = tl.zeros((PAIRS,), tl.int32)
        zero = tl.zeros((PAIRS,), tl.float32)
        sx, sy, sz, lx, ly, lz = zero, zero, zero, zero, zero, zero
        for edge in range(6):
            start, end, fa, fb, fc = _chosen(edge, ia, ib, ic, ja, jb, jc)
            inside, t, u, v, nx, ny, nz, rx, ry, rz, ex, ey, ez = _edge(points, start, end, fa, fb, fc, counts)
            first = inside & (hits == 0)
            sx, sy, sz = tl.where(first, rx, sx), tl.where(first, ry, sy), tl.where(first, rz, sz)
            lx, ly, lz = tl.where(inside, rx, lx), tl.where(inside, ry, ly), tl.where(inside, rz, lz)
            hits += inside.to(tl.int32)
        counts &= hits == 2
        gx, gy, gz = sx - lx, sy - ly, sz - lz
        length = tl.sqrt(dot(gx, gy, gz, gx, gy, gz))
        whole += tl.sum(tl.where(counts, length, 0.0), 0)
        length = tl.maximum(length, TINY)
        gx, gy, gz = gx / length, gy / length, gz / length
        ends = tl.zeros((PAIRS,), tl.int32)
        for edge in range(6):
            start, end, fa, fb, fc = _chosen(edge, ia, ib, ic, ja, jb, jc)
            inside, t, u, v, nx, ny, nz, rx, ry, rz, ex, ey, ez = _edge(points, start, end, fa, fb, fc, counts)
            sign = tl.where(ends == 0, 1.0, -1.0)
            fx, fy, fz = sign * gx, sign * gy, sign * gz
            slope = dot(nx, ny, nz, ex, ey, ez)
            least = steepest * tl.sqrt(dot(nx, ny, nz, nx, ny, nz) * dot(ex, ey, ez, ex, ey, ez)) + TINY
            slope = tl.where(slope < 0, -1.0, 1.0) * tl.maximum(tl.abs(slope), least)
            along = -dot(fx, fy, fz, ex, ey, ez) / slope
            nx, ny, nz = along * nx, along * ny, along * nz
            fx, fy, fz = fx + nx, fy + ny, fz + nz
            _add(gradient, start, inside, (1 - t) * fx, (1 - t) * fy, (1 - t) * fz)
            _add(gradient, end, inside, t * fx, t * fy, t * fz)
            _add(gradient, fa, inside, -(1 - u - v) * nx, -(1 - u - v) * ny, -(1 - u - v) * nz)
            _add(gradient, fb, inside, -u * nx, -u * ny, -u * nz)
            _add(gradient, fc, inside, -v * nx, -v * ny, -v * nz)
            ends += inside.to(tl.int32)
    tl.store(lengths + place, whole)
