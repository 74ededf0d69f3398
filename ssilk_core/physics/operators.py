# SPDX-License-Identifier: Apache-2.0
"""Sparse linear operators on vertex positions, with a deterministic gradient.

Positions are laid out (vertices, 3, frames): frames of a vertex are contiguous, so that gathering a vertex is one
block copy. The transposed operator, a sum over the incident elements of each vertex, needs no atomics.
"""

from __future__ import annotations

import warnings

import numpy as np
import torch
from torch import Tensor

from ..scene.assets import Floats, Ints


class _Apply(torch.autograd.Function):
    @staticmethod
    def forward(ctx: torch.autograd.function.FunctionCtx, x: Tensor, matrix: Tensor, transposed: Tensor) -> Tensor:
        ctx.matrix, ctx.transposed = matrix, transposed  # type: ignore[attr-defined]
        return matrix @ x

    @staticmethod
    def backward(ctx: torch.autograd.function.FunctionCtx, grad: Tensor) -> tuple[Tensor, None, None]:
        matrix, transposed = ctx.matrix, ctx.transposed  # type: ignore[attr-defined]
        return _Apply.apply(grad.contiguous(), transposed, matrix), None, None


class SparseOperator:
    """A sparse matrix that maps (vertices, 3, frames) to (rows, 3, frames)."""

    def __init__(
        self,
        rows: Ints,
        columns: Ints,
        values: Floats,
        shape: tuple[int, int],
        device: torch.device,
        dtype: torch.dtype,
    ) -> None:
        def sorted_by(first: Ints, second: Ints, size: tuple[int, int]) -> Tensor:
            order = _order(first, second)
            row, column = (torch.as_tensor(np.asarray(part)[order], device=device) for part in (first, second))
            return csr(row, column, torch.as_tensor(np.asarray(values)[order], dtype=dtype, device=device), size)

        self.matrix = sorted_by(rows, columns, shape)
        self.transposed = sorted_by(columns, rows, (shape[1], shape[0]))

    def __call__(self, x: Tensor) -> Tensor:
        """Apply the operator to `x`, shape (vertices, 3, frames)."""
        flat = x.reshape(x.shape[0], -1)
        return _Apply.apply(flat, self.matrix, self.transposed).reshape(-1, *x.shape[1:])

    def adjoint(self, y: Tensor) -> Tensor:
        """Apply the transposed operator to `y`, shape (rows, 3, frames); without gradients."""
        return (self.transposed @ y.flatten(1)).reshape(-1, *y.shape[1:])


class Entries:
    """Changes the entries of operators in place, which a captured CUDA graph reads where they were.

    Args:
        rows, columns: of the entries, in the order in which the operators were given them.
    """

    def __init__(self, rows: Ints, columns: Ints, device: torch.device) -> None:
        orders = _order(rows, columns), _order(columns, rows)
        self._order, self._transposed = (torch.as_tensor(order, device=device) for order in orders)

    def fill(self, operator: SparseOperator, values: Tensor) -> None:
        """Give an operator other entries, in the same order."""
        operator.matrix.values().copy_(values[self._order])
        operator.transposed.values().copy_(values[self._transposed])


def _order(first: Ints, second: Ints) -> Ints:
    return np.lexsort((second, first))


def csr(rows: Tensor, columns: Tensor, values: Tensor, shape: tuple[int, int]) -> Tensor:
    """Return a sparse matrix from entries in ascending rows: their rows, columns and values, each of shape (E,)."""
    starts = torch.zeros(shape[0] + 1, dtype=torch.int32, device=rows.device)
    starts[1:] = torch.bincount(rows, minlength=shape[0]).cumsum(0)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sparse (CSR|invariant)")  # a notice that they are in beta
        return torch.sparse_csr_tensor(starts, columns.int(), values, size=shape)


def difference_operator(
    heads: Ints, tails: Ints, vertex_count: int, device: torch.device, dtype: torch.dtype
) -> SparseOperator:
    """Return the operator whose row i is x[heads[i]] - x[tails[i]]."""
    count = len(heads)
    rows = np.concatenate([np.arange(count), np.arange(count)])
    values = np.concatenate([np.ones(count), -np.ones(count)])
    return SparseOperator(rows, np.concatenate([heads, tails]), values, (count, vertex_count), device, dtype)
