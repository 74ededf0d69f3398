# SPDX-License-Identifier: Apache-2.0
"""Symmetric matrices of 3 x 3 blocks over the free vertices of a garment, one for each frame.

The sparsity is found once. Element blocks are summed into vertex blocks by constant sparse operators, and the vertex
blocks of all frames make one block-diagonal matrix in compressed rows, which every device multiplies fast.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..assets import Ints
from ..energy.operators import SparseOperator


def adjoint(operator: SparseOperator, y: Tensor) -> Tensor:
    """Apply the transpose of an operator to `y` (rows, 3, N)."""
    return (operator.transposed @ y.flatten(1)).reshape(-1, *y.shape[1:])


@dataclass(frozen=True, eq=False)
class BlockMatrix:
    """A symmetric matrix for each of N frames.

    Attributes:
        rows: all of them, block-diagonal, in compressed rows, (3 U N, 3 U N) for U free vertices.
        diagonal: the diagonal blocks, shape (N, U, 3, 3).
    """

    rows: Tensor
    diagonal: Tensor

    def __matmul__(self, vectors: Tensor) -> Tensor:
        """Multiply vectors (N, U, 3)."""
        return torch.mv(self.rows, vectors.reshape(-1)).reshape(vectors.shape)


class BlockPattern:
    """Where the blocks of a matrix stand: on the diagonal, and at `pairs` of vertices, each in both orders.

    Args:
        pairs: every two vertices that may share an element, in any order and number, shape (M, 2).
        free: the vertices that the matrix is about; pairs with others are left out, shape (U,).
    """

    def __init__(self, pairs: Ints, free: Ints, vertex_count: int, device: torch.device) -> None:
        self.device, self.count = device, len(free)
        self.place = np.full(vertex_count, -1)
        self.place[free] = np.arange(len(free))
        low, high = self._ordered(pairs)
        self.keys = np.unique((low * self.count + high)[(low >= 0) & (low < high)])
        self._index_rows()
        self._tiled: tuple[int, Tensor, Tensor] | None = None  # of one number of frames, which is used for long

    @property
    def block_count(self) -> int:
        """How many blocks are stored: the diagonal, then those above it."""
        return self.count + len(self.keys)

    def _ordered(self, pairs: Ints) -> tuple[Ints, Ints]:
        low, high = np.sort(self.place[pairs], axis=1).T
        return low, high

    def slots(self, pairs: Ints) -> Ints:
        """Return where the block of each pair (M, 2) is stored, -1 where a vertex is not free, shape (M,)."""
        low, high = self._ordered(pairs)
        above = self.count + np.searchsorted(self.keys, low * self.count + high)
        return np.where(low < 0, -1, np.where(low == high, low, above))

    def summation(self, slots: Ints, sources: Ints, weights: np.ndarray, source_count: int) -> SparseOperator:
        """Return the float32 operator that adds weighted element blocks `sources` to the stored blocks `slots`."""
        kept = slots >= 0
        shape = (self.block_count, source_count)
        return SparseOperator(slots[kept], sources[kept], weights[kept], shape, self.device, torch.float32)

    def _index_rows(self) -> None:
        """Find the stored entry behind each entry of the compressed rows of one frame."""
        low, high = self.keys // self.count, self.keys % self.count
        above = self.count + np.arange(len(self.keys))
        own, none = np.arange(self.count), np.zeros(self.count + len(low), dtype=bool)
        row, column = np.concatenate([own, low, high]), np.concatenate([own, high, low])
        stored, below = np.concatenate([own, above, above]), np.concatenate([none, np.ones(len(low), dtype=bool)])
        order = np.lexsort((column, row))
        stored, below, column = (part[order, None, None] for part in (stored, below, column))
        a, b = np.mgrid[:3, :3]
        entries = 9 * stored + np.where(below, 3 * b + a, 3 * a + b)
        # Rows of numbers, not of blocks: for each vertex and axis all its blocks in turn.
        axes = 3 * row[order, None, None] + a
        by_row = np.argsort(axes.reshape(-1), kind="stable")

        def tensor(values: np.ndarray) -> Tensor:
            return torch.as_tensor(values, device=self.device)

        self.entries = tensor(entries.reshape(-1)[by_row])
        self.columns = tensor((3 * column + b + 0 * a).reshape(-1)[by_row])
        self.ends = tensor(np.bincount(axes.reshape(-1)).cumsum())

    def _tile(self, frames: int) -> tuple[Tensor, Tensor]:
        """Return row starts and columns of the block-diagonal matrix of so many frames."""
        if self._tiled is None or self._tiled[0] != frames:
            frame = torch.arange(frames, device=self.device)[:, None]
            starts = (self.ends + frame * len(self.columns)).reshape(-1)
            columns = (self.columns + frame * 3 * self.count).reshape(-1)
            self._tiled = frames, torch.cat([starts.new_zeros(1), starts]).int(), columns.int()
        return self._tiled[1:]

    def matrix(self, blocks: Tensor) -> BlockMatrix:
        """Return the matrix of stored blocks (stored, 3, 3, N); those on the diagonal must be symmetric."""
        frames = blocks.shape[-1]
        values = blocks.reshape(-1, frames)[self.entries].T.reshape(-1)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Sparse (CSR|invariant)")
            side = 3 * self.count * frames
            rows = torch.sparse_csr_tensor(*self._tile(frames), values, size=(side, side))
        return BlockMatrix(rows, blocks[: self.count].permute(3, 0, 1, 2).contiguous())
