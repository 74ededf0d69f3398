# SPDX-License-Identifier: Apache-2.0
"""Sparse matrices on vertex positions; reference: `operators.SparseOperator`.

A program owns one row in a block of frames. The gradient is the transposed matrix: there are no atomics, and results
are deterministic.
"""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from .vectors import load3, store3

FRAMES, WARPS = 128, 2  # of one program


def rows_kernel(x: Tensor, matrix: Tensor, transposed: Tensor) -> Tensor:
    """Return the product of a CSR matrix (R, V) with positions x (V, 3, N), shape (R, 3, N).

    Args:
        matrix, transposed: the matrix and its transpose, float32 with int32 indices.
    """
    return _Rows.apply(x, matrix, transposed)


def _product(matrix: Tensor, x: Tensor) -> Tensor:
    x, (rows, frames) = x.contiguous(), (matrix.shape[0], x.shape[2])
    out = x.new_empty(rows, 3, frames)
    entries = matrix.crow_indices(), matrix.col_indices(), matrix.values()
    _rows[rows, triton.cdiv(frames, FRAMES)](*entries, x, out, frames, FRAMES, num_warps=WARPS)
    return out


class _Rows(Function):
    @staticmethod
    def forward(ctx, x, matrix, transposed):
        ctx.transposed = transposed
        return _product(matrix, x)

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream):
        return _product(ctx.transposed, upstream), None, None


@triton.jit
def _rows(starts, columns, values, x, out, frames, block: tl.constexpr):
    row = tl.program_id(0).to(tl.int64)
    n = tl.program_id(1) * block + tl.arange(0, block)
    inside = n < frames
    sx, sy, sz = tl.zeros((block,), tl.float32), tl.zeros((block,), tl.float32), tl.zeros((block,), tl.float32)
    for entry in range(tl.load(starts + row), tl.load(starts + row + 1)):
        weight = tl.load(values + entry)
        px, py, pz = load3(x + tl.load(columns + entry).to(tl.int64) * 3 * frames, frames, n, inside)
        sx, sy, sz = sx + weight * px, sy + weight * py, sz + weight * pz
    store3(out + row * 3 * frames, frames, n, inside, sx, sy, sz)
