# SPDX-License-Identifier: Apache-2.0
"""Conjugate gradients on symmetric block matrices; reference: `simulate.conjugate_gradient`.

The frames of a batch share one sparsity pattern: columns are read once for all of them, and of two symmetric blocks
only one is stored. A program owns some rows and some frames. It writes its part of an inner product to its own row;
the programs of the next kernel sum these in a fixed order. The host is not involved and results are deterministic.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
import triton
import triton.language as tl
from torch import Tensor

from ..captured import captured, replays, rounded_up
from .slopes import SlopeTable, summed_slopes

ROWS, FRAMES, WARPS = 16, 32, 4  # rows, maximum number of frames, and warps of one program
LEAST_SLOPES = 1024  # for which a graph has room
CHUNK = tl.constexpr(32)  # parts of an inner product summed together
TINY = tl.constexpr(1.1754943508222875e-38)


@dataclass(frozen=True, eq=False)
class BlockTable:
    """The blocks of each row.

    Attributes:
        columns: their columns, shape (U, W), int32; shorter rows are padded.
        places: 2 i for the stored block i, 2 i + 1 for its transpose, shape (U, W), int32.
        counts: blocks of each row, shape (U,), int32.
        captured: solves that are captured as CUDA graphs.
    """

    columns: Tensor
    places: Tensor
    counts: Tensor
    captured: dict[tuple[int, int, int, float], _CapturedSolve] = field(default_factory=dict, init=False)


def solve_kernel(
    blocks: Tensor,
    table: BlockTable,
    inverse: Tensor,
    right: Tensor,
    reduction: float,
    iterations: int,
    check_every: int,
    slopes: SlopeTable | None = None,
) -> tuple[Tensor, int]:
    """Return the result of `simulate.conjugate_gradient.solve`, preconditioned with the inverse diagonal blocks.

    Args:
        blocks: as stored, shape (S, 3, 3, N), float32.
        inverse: shape (U, 3, 3, N); right: shape (U, 3, N).
        check_every: iterations between convergence checks, which synchronise with the GPU.
        slopes: G of a stiffness G'G that is added, or None.
    """
    if iterations % check_every == 0 and replays(right):
        room = 0 if slopes is None else max(LEAST_SLOPES, triton.next_power_of_2(len(slopes.frame)))
        key = rounded_up(right.shape[-1]), room, check_every, reduction
        if key not in table.captured:
            table.captured[key] = _CapturedSolve(blocks, table, right, *key)
        return table.captured[key](blocks, inverse, right, slopes, iterations)
    own = _Search(
        blocks.contiguous(), table, inverse.contiguous(), right.clone(memory_format=torch.contiguous_format), slopes
    )
    own.begin(reduction)
    for done in range(1, iterations + 1):
        own.iterate()
        if done % check_every == 0 and own.has_converged():
            break
    return own.z, done


class _Search:
    """The vectors of conjugate gradients, which change in place.

    Args:
        residual: the right side.
    """

    def __init__(
        self, blocks: Tensor, table: BlockTable, inverse: Tensor, residual: Tensor, slopes: SlopeTable | None
    ) -> None:
        rows, _, frames = residual.shape
        tile = min(FRAMES, triton.next_power_of_2(frames))
        self.grid = triton.cdiv(rows, ROWS), triton.cdiv(frames, tile)
        self.size = rows, frames, ROWS, tile
        self.blocks, self.table, self.inverse, self.residual = blocks, table, inverse, residual
        self.slopes = slopes
        none = table.counts  # read by nobody
        self.given = (none,) * 5 if slopes is None else (slopes.values, slopes.entries, slopes.first, slopes.last,
                                                         residual.new_empty(len(slopes.frame)))  # fmt: skip
        self.y, self.step, self.image, self.z = (torch.empty_like(residual) for _ in range(4))
        self.product, self.fresh, self.enough = residual.new_empty(3, frames).unbind()
        self.along, self.left = residual.new_empty(2, self.grid[0], frames).unbind()

    def begin(self, reduction: float) -> None:
        """Start from zero."""
        self.y.copy_((self.inverse * self.residual[:, None]).sum(2))
        self.step.copy_(self.y)
        self.z.zero_()
        self.product.copy_((self.residual * self.y).sum((0, 1)))
        self.enough.copy_(self.product * reduction**2)

    def iterate(self) -> None:
        """Make an iteration."""
        columns, places, counts = self.table.columns, self.table.places, self.table.counts
        if self.slopes is not None:
            self.slopes.along(self.step, self.given[-1])
        _multiply[self.grid](self.blocks, columns, places, counts, self.step, self.image, self.along, *self.given,
                             len(self.given[-1]), columns.shape[1], *self.size, self.slopes is not None,
                             num_warps=WARPS)  # fmt: skip
        parts = self.grid[0]
        _descend[self.grid](self.z, self.residual, self.y, self.step, self.image, self.inverse, self.product,
                            self.enough, self.along, self.left, parts, *self.size, num_warps=WARPS)  # fmt: skip
        _turn[self.grid](self.step, self.y, self.product, self.fresh, self.left, self.grid[0], *self.size,
                         num_warps=WARPS)  # fmt: skip
        self.product, self.fresh = self.fresh, self.product

    def has_converged(self) -> bool:
        """Return whether no frame goes on; this waits for the GPU."""
        return not bool((self.product > self.enough).any())


class _CapturedSolve:
    """A solve in memory of its own, with graphs of its beginning and of some iterations (`physics.captured`)."""

    _own: _Search

    def __init__(
        self,
        blocks: Tensor,
        table: BlockTable,
        right: Tensor,
        capacity: int,
        room: int,
        several: int,
        reduction: float,
    ) -> None:
        slopes = SlopeTable.empty(room, len(right), capacity, right.device) if room else None
        alike = next((each._own for (frames, *_), each in table.captured.items() if frames == capacity), None)
        if alike is not None:  # one solve is over before another begins, and may use the memory of what is given
            kept, inverse, residual = alike.blocks, alike.inverse, alike.residual
        else:
            kept, inverse = (blocks.new_zeros(rows, 3, 3, capacity) for rows in (len(blocks), len(right)))
            residual = right.new_zeros(*right.shape[:-1], capacity)
        own = _Search(kept, table, inverse, residual, slopes)
        self._own, self._several = own, several + several % 2  # `product` and `fresh` change places in each

        def iterate() -> None:
            for _ in range(self._several):
                own.iterate()

        device = right.device
        self._begin, self._iterate = captured(lambda: own.begin(reduction), device), captured(iterate, device)

    def __call__(
        self, blocks: Tensor, inverse: Tensor, right: Tensor, slopes: SlopeTable | None, iterations: int
    ) -> tuple[Tensor, int]:
        own, frames = self._own, right.shape[-1]
        for kept, given in ((own.blocks, blocks), (own.inverse, inverse), (own.residual, right)):
            kept[..., :frames].copy_(given)
        if own.slopes is not None and slopes is not None:
            own.slopes.put(slopes)
        own.residual[..., frames:].zero_()  # what is solved for nothing has converged
        self._begin.replay()
        done = 0
        while done < iterations:
            self._iterate.replay()
            done += self._several
            if own.has_converged():
                break
        return own.z[..., :frames].clone(memory_format=torch.contiguous_format), done


@triton.jit
def _tile(rows, frames, block_u: tl.constexpr, block_n: tl.constexpr):
    """Rows and frames of a program, the mask of valid ones, and the start of its vectors."""
    u, n = tl.program_id(0) * block_u + tl.arange(0, block_u), tl.program_id(1) * block_n + tl.arange(0, block_n)
    inside = (u < rows)[:, None] & (n < frames)[None, :]
    return u, n, inside, u.to(tl.int64)[:, None] * 3 * frames + n[None, :]


@triton.jit
def _load3(base, width, mask):
    return (
        tl.load(base, mask=mask, other=0.0),
        tl.load(base + width, mask=mask, other=0.0),
        tl.load(base + 2 * width, mask=mask, other=0.0),
    )


@triton.jit
def _store3(base, width, mask, x, y, z):
    tl.store(base, x, mask=mask)
    tl.store(base + width, y, mask=mask)
    tl.store(base + 2 * width, z, mask=mask)


@triton.jit
def _summed(parts, count, frames, n, block_n: tl.constexpr):
    """Sum the parts of an inner product, for frames n."""
    total = tl.zeros((block_n,), tl.float32)
    for start in range(0, count, CHUNK):
        part = start + tl.arange(0, CHUNK)
        mask = (part < count)[:, None] & (n < frames)[None, :]
        total += tl.sum(tl.load(parts + part[:, None] * frames + n[None, :], mask=mask, other=0.0), axis=0)
    return total


@triton.jit
def _multiply(blocks, columns, places, counts, step, image, along, values, entries, first, last, slips, slopes,
              width, rows, frames, block_u: tl.constexpr, block_n: tl.constexpr, sloped: tl.constexpr):  # fmt: skip
    u, n, inside, own = _tile(rows, frames, block_u, block_n)
    count = tl.load(counts + u, mask=u < rows, other=0)
    zero = tl.zeros((block_u, block_n), tl.float32)
    ax, ay, az = zero, zero, zero
    for k in range(tl.max(count, axis=0)):
        here = k < count
        column = tl.load(columns + u * width + k, mask=here, other=0).to(tl.int64)[:, None]
        place = tl.load(places + u * width + k, mask=here, other=0).to(tl.int64)[:, None]
        mask = here[:, None] & (n < frames)[None, :]
        vx, vy, vz = _load3(step + column * 3 * frames + n[None, :], frames, mask)
        block, turned = blocks + place // 2 * 9 * frames + n[None, :], (place % 2) == 1
        row, line = tl.where(turned, frames, 3 * frames), tl.where(turned, 3 * frames, frames)
        xx, xy, xz = _load3(block, line, mask)
        yx, yy, yz = _load3(block + row, line, mask)
        zx, zy, zz = _load3(block + 2 * row, line, mask)
        ax += xx * vx + xy * vy + xz * vz
        ay += yx * vx + yy * vy + yz * vz
        az += zx * vx + zy * vy + zz * vz
    if sloped:
        at = u[:, None] * frames + n[None, :]
        ax, ay, az = summed_slopes(values, entries, first, last, slips, slopes, at, inside, ax, ay, az)
    _store3(image + own, frames, inside, ax, ay, az)
    sx, sy, sz = _load3(step + own, frames, inside)
    tl.store(along + tl.program_id(0) * frames + n, tl.sum(ax * sx + ay * sy + az * sz, axis=0), mask=n < frames)


@triton.jit
def _descend(z, residual, y, step, image, inverse, product, enough, along, left, parts, rows, frames,
             block_u: tl.constexpr, block_n: tl.constexpr):  # fmt: skip
    u, n, inside, own = _tile(rows, frames, block_u, block_n)
    before = tl.load(product + n, mask=n < frames, other=0.0)
    curvature = _summed(along, parts, frames, n, block_n)
    # Converged frames and frames with an indefinite matrix take no more steps, as in `conjugate_gradient.solve`.
    moves = (before > tl.load(enough + n, mask=n < frames, other=0.0)) & (curvature > 0)
    rate = tl.where(moves, before / tl.maximum(curvature, TINY), 0.0)[None, :]
    zx, zy, zz = _load3(z + own, frames, inside)
    sx, sy, sz = _load3(step + own, frames, inside)
    _store3(z + own, frames, inside, zx + rate * sx, zy + rate * sy, zz + rate * sz)
    rx, ry, rz = _load3(residual + own, frames, inside)
    ix, iy, iz = _load3(image + own, frames, inside)
    rx, ry, rz = rx - rate * ix, ry - rate * iy, rz - rate * iz
    _store3(residual + own, frames, inside, rx, ry, rz)
    block = inverse + u.to(tl.int64)[:, None] * 9 * frames + n[None, :]
    xx, xy, xz = _load3(block, frames, inside)
    yx, yy, yz = _load3(block + 3 * frames, frames, inside)
    zx, zy, zz = _load3(block + 6 * frames, frames, inside)
    px, py, pz = xx * rx + xy * ry + xz * rz, yx * rx + yy * ry + yz * rz, zx * rx + zy * ry + zz * rz
    _store3(y + own, frames, inside, px, py, pz)
    now = tl.where(moves, tl.sum(px * rx + py * ry + pz * rz, axis=0), 0.0)
    tl.store(left + tl.program_id(0) * frames + n, now, mask=n < frames)


@triton.jit
def _turn(step, y, product, fresh, left, parts, rows, frames, block_u: tl.constexpr, block_n: tl.constexpr):
    _u, n, inside, own = _tile(rows, frames, block_u, block_n)
    now = _summed(left, parts, frames, n, block_n)
    share = (now / tl.maximum(tl.load(product + n, mask=n < frames, other=0.0), TINY))[None, :]
    sx, sy, sz = _load3(step + own, frames, inside)
    px, py, pz = _load3(y + own, frames, inside)
    _store3(step + own, frames, inside, px + share * sx, py + share * sy, pz + share * sz)
    if tl.program_id(0) == 0:
        tl.store(fresh + n, now, mask=n < frames)
