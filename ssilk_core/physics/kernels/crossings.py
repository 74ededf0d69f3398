# SPDX-License-Identifier: Apache-2.0
"""Where segments cross triangles, and cloth around such places; references: `collision.ray_casting` and `pierced`.

A program owns a block of triangles in a block of frames, and tests all segments.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from .vectors import cross, dot, load3, store3

FRAMES = 32  # of one program; consecutive frames are contiguous in memory
TRIANGLES = 64  # of one program, one after the other
# Shares of segments are whole numbers, with the triangle in the lower bits, so that any order finds the same one.
STEPS = tl.constexpr(1 << 24)
TRIANGLE_BITS = tl.constexpr(32)
TINY = tl.constexpr(1e-30)


def crossings_kernel(starts: Tensor, ends: Tensor, x: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Return how many triangles each segment crosses, and which is the last along it, zero without a crossing.

    Args:
        starts, ends: of the segments (P, 3, N); x: vertices (V, 3, N); faces: triangles (F, 3).

    Returns:
        Counts, int32, and indices, int64, both (P, N).
    """
    starts, ends, x = starts.contiguous(), ends.contiguous(), x.contiguous()
    segments, _, frames = starts.shape
    counts = torch.zeros(segments, frames, dtype=torch.int32, device=x.device)
    last = torch.zeros(segments, frames, dtype=torch.int64, device=x.device)
    grid = (triton.cdiv(len(faces), TRIANGLES), triton.cdiv(frames, FRAMES))
    _crossings[grid](starts, ends, x, faces, counts, last, segments, len(faces), frames, TRIANGLES, FRAMES,
                     num_warps=1)  # fmt: skip
    return counts, last & ((1 << TRIANGLE_BITS.value) - 1)


@triton.jit
def _crossings(starts, ends, x, faces, counts, last, segments, face_count, frames,
               chunk: tl.constexpr, block: tl.constexpr):  # fmt: skip
    first = tl.program_id(0).to(tl.int64) * chunk
    n = tl.program_id(1) * block + tl.arange(0, block)
    inside = n < frames
    for f in range(first, tl.minimum(first + chunk, face_count)):
        ax, ay, az = load3(x + tl.load(faces + 3 * f) * 3 * frames, frames, n, inside)
        bx, by, bz = load3(x + tl.load(faces + 3 * f + 1) * 3 * frames, frames, n, inside)
        cx, cy, cz = load3(x + tl.load(faces + 3 * f + 2) * 3 * frames, frames, n, inside)
        bx, by, bz, cx, cy, cz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
        nx, ny, nz = cross(bx, by, bz, cx, cy, cz)
        for p in range(segments):
            sx, sy, sz = load3(starts + p * 3 * frames, frames, n, inside)
            dx, dy, dz = load3(ends + p * 3 * frames, frames, n, inside)
            dx, dy, dz, sx, sy, sz = dx - sx, dy - sy, dz - sz, sx - ax, sy - ay, sz - az
            volume = dot(dx, dy, dz, nx, ny, nz)
            height = -dot(sx, sy, sz, nx, ny, nz)
            # With both signs made equal, 0 <= height <= volume is the share between zero and one.
            sign = tl.where(volume < 0, -1.0, 1.0)
            volume, height = volume * sign, height * sign
            through = inside & (height >= 0) & (height <= volume) & (volume > 0)
            if tl.max(through.to(tl.int32), axis=0) > 0:
                ox, oy, oz = cross(sx, sy, sz, dx, dy, dz)
                u = -dot(cx, cy, cz, ox, oy, oz) * sign
                v = dot(bx, by, bz, ox, oy, oz) * sign
                crossed = through & (u >= 0) & (v >= 0) & (u + v <= volume)
                place = (height / tl.maximum(volume, TINY) * STEPS).to(tl.int64)
                tl.atomic_add(counts + p * frames + n, 1, mask=crossed)
                tl.atomic_max(last + p * frames + n, (place << TRIANGLE_BITS) | f, mask=crossed)


def replace_planes_kernel(
    rest: Tensor,
    loose: Tensor,
    pierced: tuple[Tensor, Tensor, Tensor, Tensor],
    slope: float,
    normal: Tensor,
    offset: Tensor,
    curvature: Tensor | None = None,
) -> None:
    """Replace, in place, the planes of loose samples around crossings; their curvature becomes zero.

    Args:
        rest: samples at rest (S, 3); loose: which of them are, bool (S,).
        pierced: `collision.pierced.PiercedCloth`.
        slope: length of the new normals.
        normal: (S, 3, N), and offset: (S, N), in any precision; curvature: (S, 3, 3, N), or None.
    """
    point, direction, tip, radius = (values.contiguous() for values in pierced)
    bent = normal if curvature is None else curvature
    assert all(values.is_contiguous() for values in (rest, normal, offset, bent))
    samples, _, frames = normal.shape
    grid = (samples, triton.cdiv(frames, FRAMES))
    _replace[grid](rest, loose, point, direction, tip, radius, normal, offset, bent, slope, len(point), frames,
                   curvature is not None, FRAMES, num_warps=1)  # fmt: skip


@triton.jit
def _replace(rest, loose, point, direction, tip, radius, normal, offset, curvature, slope, limbs, frames,
             bent: tl.constexpr, block: tl.constexpr):  # fmt: skip
    s = tl.program_id(0).to(tl.int64)
    if tl.load(loose + s) == 0:
        return
    n = tl.program_id(1) * block + tl.arange(0, block)
    inside = n < frames
    px, py, pz = tl.load(rest + 3 * s), tl.load(rest + 3 * s + 1), tl.load(rest + 3 * s + 2)
    for limb in range(limbs):
        reach = tl.load(radius + limb * frames + n, mask=inside, other=0.0)
        if tl.max(reach, axis=0) > 0:
            cx, cy, cz = load3(point + limb * 3 * frames, frames, n, inside)
            cx, cy, cz = cx - px, cy - py, cz - pz
            near = inside & (dot(cx, cy, cz, cx, cy, cz) < reach * reach)
            dx, dy, dz = load3(direction + limb * 3 * frames, frames, n, near)
            store3(normal + s * 3 * frames, frames, n, near, slope * dx, slope * dy, slope * dz)
            far = tl.load(tip + limb * frames + n, mask=near, other=0.0)
            tl.store(offset + s * frames + n, slope * far, mask=near)
            if bent:
                for entry in range(9):
                    tl.store(curvature + (s * 9 + entry) * frames + n, far * 0, mask=near)
