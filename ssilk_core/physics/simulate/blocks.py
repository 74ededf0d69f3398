# SPDX-License-Identifier: Apache-2.0
"""Symmetric matrices of 3 x 3 blocks over the free vertices of a garment, one for each frame.

The sparsity pattern is found once. Constant sparse operators sum element blocks into vertex blocks. Kernels solve
systems on the blocks where available; elsewhere the blocks of all frames form one block-diagonal CSR matrix.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from ...scene.assets import Ints
from .. import kernels
from ..operators import SparseOperator
from .conjugate_gradient import CHECK_EVERY, inverse_blocks, solve
from .contact_stiffness import ContactStiffness

if TYPE_CHECKING:
    from ..kernels.conjugate_gradient import BlockTable
    from ..loops.block_products import BlockRows


@dataclass(frozen=True, eq=False)
class BlockMatrix:
    """A symmetric matrix for each of N frames.

    Attributes:
        blocks: stored blocks, first those on the diagonal, shape (stored, 3, 3, N).
        contacts: what is added for contacts of cloth with cloth, or None.
        inverse: what `inverse_diagonal` returns, where it is known.
    """

    pattern: BlockPattern
    blocks: Tensor
    contacts: ContactStiffness | None = None
    inverse: Tensor | None = None

    @cached_property
    def rows(self) -> Tensor:
        """The matrices of all frames as one block-diagonal CSR matrix, (3 U N, 3 U N) for U free vertices."""
        return self.pattern.rows(self.blocks)

    def __matmul__(self, vectors: Tensor) -> Tensor:
        """Multiply vectors (N, U, 3)."""
        image = torch.mv(self.rows, vectors.reshape(-1)).reshape(vectors.shape)
        if self.contacts is not None:
            added = vectors.new_zeros(*vectors.shape[1:], len(vectors))
            self.contacts.add_product(vectors.permute(1, 2, 0).contiguous(), added)
            image += added.permute(2, 0, 1)
        return image

    def inverse_diagonal(self, added: Tensor | None = None) -> Tensor:
        """Return the inverses of the blocks on the diagonal, shape (U, 3, 3, N).

        Args:
            added: to these blocks, in place of those of `contacts`.
        """
        diagonal = self.blocks[: self.pattern.count]
        if added is None and self.contacts is not None:
            added = self.contacts.diagonal
        if added is not None:
            diagonal = diagonal + added
        return inverse_blocks(diagonal.permute(3, 0, 1, 2).contiguous()).permute(1, 2, 3, 0)

    def solve(
        self, right: Tensor, reduction: float, iterations: int, check_every: int = CHECK_EVERY
    ) -> tuple[Tensor, int]:
        """Solve approximately for right sides (U, 3, N).

        Other arguments and the result are those of `conjugate_gradient.solve`.

        Args:
            check_every: iterations between checks of a GPU for convergence, which wait for it.
        """
        inverse = self.inverse_diagonal() if self.inverse is None else self.inverse
        if kernels.available(right.device):
            from ..kernels.conjugate_gradient import solve_kernel

            table = self.pattern.table
            slopes = None if self.contacts is None else self.contacts.table
            return solve_kernel(self.blocks, table, inverse, right, reduction, iterations, check_every, slopes)
        inverse = inverse.permute(3, 0, 1, 2)
        z, count = solve(
            lambda v: self @ v,
            lambda r: (inverse * r[..., None, :]).sum(-1),
            right.permute(2, 0, 1).contiguous(),
            reduction,
            iterations,
        )
        return z.permute(1, 2, 0), count


class BlockPattern:
    """The sparsity pattern of a symmetric block matrix: the diagonal, and pairs of vertices.

    Args:
        pairs: vertices that share an element, in any order, repetitions allowed, shape (M, 2).
        free: vertices of the matrix, shape (U,); pairs with other vertices are ignored.
    """

    def __init__(self, pairs: Ints, free: Ints, vertex_count: int, device: torch.device) -> None:
        self.device, self.count = device, len(free)
        self.place = np.full(vertex_count, -1)
        self.place[free] = np.arange(len(free))
        low, high = self._ordered(pairs)
        self.keys = np.unique((low * self.count + high)[(low >= 0) & (low < high)])
        self._tiled: tuple[int, Tensor, Tensor] | None = None  # cached for one number of frames

    @property
    def block_count(self) -> int:
        """Number of stored blocks: the diagonal and those above it."""
        return self.count + len(self.keys)

    def _ordered(self, pairs: Ints) -> tuple[Ints, Ints]:
        low, high = np.sort(self.place[pairs], axis=1).T
        return low, high

    def slots(self, pairs: Ints) -> Ints:
        """Return the index of the stored block of each pair (M, 2), -1 where a vertex is not free, shape (M,)."""
        low, high = self._ordered(pairs)
        above = self.count + np.searchsorted(self.keys, low * self.count + high)
        return np.where(low < 0, -1, np.where(low == high, low, above))

    def summation(self, slots: Ints, sources: Ints, weights: np.ndarray, source_count: int) -> SparseOperator:
        """Return the float32 operator that adds weighted element blocks `sources` to the stored blocks `slots`."""
        kept = slots >= 0
        shape = (self.block_count, source_count)
        return SparseOperator(slots[kept], sources[kept], weights[kept], shape, self.device, torch.float32)

    def _blocks(self) -> tuple[Ints, Ints, Ints, np.ndarray]:
        """Return row, column, stored block and whether it is transposed, for all blocks in order, (E,)."""
        low, high = self.keys // self.count, self.keys % self.count
        above = self.count + np.arange(len(self.keys))
        own, none = np.arange(self.count), np.zeros(self.count + len(low), dtype=bool)
        row, column = np.concatenate([own, low, high]), np.concatenate([own, high, low])
        stored, below = np.concatenate([own, above, above]), np.concatenate([none, np.ones(len(low), dtype=bool)])
        order = np.lexsort((column, row))
        return row[order], column[order], stored[order], below[order]

    @cached_property
    def table(self) -> BlockTable:
        """Return the blocks of each row, for kernels."""
        from ..kernels.conjugate_gradient import BlockTable

        row, column, stored, below = self._blocks()
        counts = np.bincount(row, minlength=self.count)
        at = np.arange(len(row)) - np.repeat(counts.cumsum() - counts, counts)
        columns, places = np.zeros((2, self.count, counts.max()), dtype=np.int32)
        columns[row, at], places[row, at] = column, 2 * stored + below
        tables = columns, places, counts.astype(np.int32)
        return BlockTable(*[torch.as_tensor(values, device=self.device) for values in tables])

    @cached_property
    def block_rows(self) -> BlockRows:
        """Return the blocks of each row, for loops."""
        from ..loops.block_products import BlockRows

        row, column, stored, below = self._blocks()
        return BlockRows(np.searchsorted(row, np.arange(self.count + 1)), column, stored, below)

    @cached_property
    def _row_entries(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return the stored entry and the column of each CSR entry of one frame, and the ends of its rows."""
        row, column, stored, below = (part[:, None, None] for part in self._blocks())
        a, b = np.mgrid[:3, :3]
        entries = 9 * stored + np.where(below, 3 * b + a, 3 * a + b)
        # Scalar rows: for each vertex and axis, the entries of all its blocks.
        axes = 3 * row + a + 0 * b
        by_row = np.argsort(axes.reshape(-1), kind="stable")

        def tensor(values: np.ndarray) -> Tensor:
            return torch.as_tensor(values, device=self.device)

        columns, ends = (3 * column + b + 0 * a).reshape(-1)[by_row], np.bincount(axes.reshape(-1)).cumsum()
        return tensor(entries.reshape(-1)[by_row]), tensor(columns), tensor(ends)

    def _tile(self, frames: int) -> tuple[Tensor, Tensor]:
        """Return row starts and columns of the block-diagonal matrix for a number of frames."""
        if self._tiled is None or self._tiled[0] != frames:
            _, columns, ends = self._row_entries
            frame = torch.arange(frames, device=self.device)[:, None]
            starts = (ends + frame * len(columns)).reshape(-1)
            columns = (columns + frame * 3 * self.count).reshape(-1)
            self._tiled = frames, torch.cat([starts.new_zeros(1), starts]).int(), columns.int()
        return self._tiled[1:]

    def rows(self, blocks: Tensor) -> Tensor:
        """Return the matrices of stored blocks (stored, 3, 3, N) as one block-diagonal CSR matrix."""
        frames = blocks.shape[-1]
        values = blocks.reshape(-1, frames)[self._row_entries[0]].T.reshape(-1)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Sparse (CSR|invariant)")
            side = 3 * self.count * frames
            return torch.sparse_csr_tensor(*self._tile(frames), values, size=(side, side))
