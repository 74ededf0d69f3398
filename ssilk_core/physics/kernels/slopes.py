# SPDX-License-Identifier: Apache-2.0
"""Products with a stiffness G'G whose pattern varies; reference: `simulate.contact_stiffness`.

Each row of G is multiplied once. The entries of each vertex are then summed in a fixed order, so that results are
deterministic.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from torch import Tensor

BLOCK = 128  # rows of one program
ROWS, FRAMES = 16, 32  # vertices, and maximum number of frames, of one program


@dataclass(frozen=True, eq=False)
class SlopeTable:
    """R rows of G, over U vertices in N frames.

    Attributes:
        vertices: of each row, shape (4, R), int32; any where the row has no value.
        frame: of each row, shape (R,), int32.
        values: of each row at its vertices, shape (4, 3, R), float32.
        entries: 4 r + c for the vertex c of the row r, by vertex and frame, shape (4 R,), int32.
        first, last: the part of these that belongs to each vertex in each frame, shape (U, N), int32.
    """

    vertices: Tensor
    frame: Tensor
    values: Tensor
    entries: Tensor
    first: Tensor
    last: Tensor

    @classmethod
    def of(cls, vertices: Tensor, frame: Tensor, values: Tensor, count: int, frames: int) -> SlopeTable:
        """Return that of rows (R,), of which vertices (4, R) that are negative are left out."""
        cells = torch.arange(count * frames, device=frame.device)
        keys, order = torch.where(vertices < 0, len(cells), vertices * frames + frame).T.flatten().sort(stable=True)
        first, last = (torch.searchsorted(keys, cells, right=right).view(count, frames) for right in (False, True))
        own = vertices >= 0
        rows = own * vertices, frame, own[:, None] * values, order, first, last
        return cls(*(each.int() if each is not rows[2] else each.contiguous() for each in rows))

    @classmethod
    def empty(cls, rows: int, count: int, frames: int, device: torch.device) -> SlopeTable:
        """Return one with room for some rows, which has none."""

        def none(*shape: int) -> Tensor:
            return torch.zeros(shape, dtype=torch.int32, device=device)

        values = torch.zeros(4, 3, rows, device=device)
        return cls(none(4, rows), none(rows), values, none(4 * rows), none(count, frames), none(count, frames))

    def put(self, other: SlopeTable) -> None:
        """Take the rows of another table, which has no more of them, and no more frames."""
        rows, frames = len(other.frame), other.first.shape[1]
        for name in ("vertices", "frame", "values"):
            getattr(self, name)[..., :rows].copy_(getattr(other, name))
        self.entries[: 4 * rows].copy_(other.entries)
        for own, given in ((self.first, other.first), (self.last, other.last)):
            own[:, :frames].copy_(given)
            own[:, frames:].zero_()

    def along(self, vectors: Tensor, to: Tensor) -> None:
        """Write G times contiguous vectors (U, 3, N) to a tensor (R,)."""
        if len(self.frame):
            grid = (triton.cdiv(len(self.frame), BLOCK),)
            _along[grid](self.vertices, self.frame, self.values, vectors, to, len(self.frame), vectors.shape[-1],
                         BLOCK, num_warps=4)  # fmt: skip

    def diagonal(self) -> Tensor:
        """Return the blocks of G'G on the diagonal, shape (U, 3, 3, N)."""
        count, frames = self.first.shape
        found, tile = self.values.new_empty(count, 3, 3, frames), min(FRAMES, triton.next_power_of_2(frames))
        grid = triton.cdiv(count, ROWS), triton.cdiv(frames, tile)
        _diagonal[grid](self.values, self.entries, self.first, self.last, found, len(self.frame), count, frames,
                        ROWS, tile, num_warps=4)  # fmt: skip
        return found


@triton.jit
def _along(vertices, frame, values, vectors, to, rows, frames, block: tl.constexpr):
    r = tl.program_id(0).to(tl.int64) * block + tl.arange(0, block)
    inside = r < rows
    start = vectors + tl.load(frame + r, mask=inside, other=0)
    total = tl.zeros((block,), tl.float32)
    for c in range(4):
        at = start + tl.load(vertices + c * rows + r, mask=inside, other=0).to(tl.int64) * 3 * frames
        for axis in range(3):
            value = tl.load(values + (3 * c + axis) * rows + r, mask=inside, other=0.0)
            total += value * tl.load(at + axis * frames, mask=inside, other=0.0)
    tl.store(to + r, total, mask=inside)


@triton.jit
def summed_slopes(values, entries, first, last, along, rows, at, inside, x, y, z):
    """Add G' times values along its rows to what vertices have in frames; `at` are their places in `first`."""
    start = tl.load(first + at, mask=inside, other=0)
    count = tl.load(last + at, mask=inside, other=0) - start
    for k in range(tl.max(tl.max(count, axis=1), axis=0)):
        here = k < count
        entry = tl.load(entries + start + k, mask=here, other=0)
        value = values + (entry % 4).to(tl.int64) * 3 * rows + entry // 4
        share = tl.load(along + entry // 4, mask=here, other=0.0)
        x += share * tl.load(value, mask=here, other=0.0)
        y += share * tl.load(value + rows, mask=here, other=0.0)
        z += share * tl.load(value + 2 * rows, mask=here, other=0.0)
    return x, y, z


@triton.jit
def _diagonal(values, entries, first, last, found, rows, vertices, frames,
              block_u: tl.constexpr, block_n: tl.constexpr):  # fmt: skip
    u, n = tl.program_id(0) * block_u + tl.arange(0, block_u), tl.program_id(1) * block_n + tl.arange(0, block_n)
    inside = (u < vertices)[:, None] & (n < frames)[None, :]
    at = u[:, None] * frames + n[None, :]
    start = tl.load(first + at, mask=inside, other=0)
    count = tl.load(last + at, mask=inside, other=0) - start
    zero = tl.zeros((block_u, block_n), tl.float32)
    xx, xy, xz, yy, yz, zz = zero, zero, zero, zero, zero, zero
    for k in range(tl.max(tl.max(count, axis=1), axis=0)):
        here = k < count
        entry = tl.load(entries + start + k, mask=here, other=0)
        value = values + (entry % 4).to(tl.int64) * 3 * rows + entry // 4
        x = tl.load(value, mask=here, other=0.0)
        y = tl.load(value + rows, mask=here, other=0.0)
        z = tl.load(value + 2 * rows, mask=here, other=0.0)
        xx += x * x
        xy += x * y
        xz += x * z
        yy += y * y
        yz += y * z
        zz += z * z
    block = found + u.to(tl.int64)[:, None] * 9 * frames + n[None, :]
    tl.store(block, xx, mask=inside)
    tl.store(block + frames, xy, mask=inside)
    tl.store(block + 2 * frames, xz, mask=inside)
    tl.store(block + 3 * frames, xy, mask=inside)
    tl.store(block + 4 * frames, yy, mask=inside)
    tl.store(block + 5 * frames, yz, mask=inside)
    tl.store(block + 6 * frames, xz, mask=inside)
    tl.store(block + 7 * frames, yz, mask=inside)
    tl.store(block + 8 * frames, zz, mask=inside)
