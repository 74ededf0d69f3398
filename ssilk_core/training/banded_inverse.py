# SPDX-License-Identifier: Apache-2.0
"""Solves systems with one sparse matrix of a surface for many right-hand sides.

In the order of Cuthill and McKee the matrix of a surface of n vertices is a band whose width w is about that of the
surface. In blocks of w rows it is tridiagonal, and so is its Cholesky factor L: solving costs about 6 n w products
for each right-hand side, not the n^2 of a dense inverse.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

LEAST_BLOCK = 16  # rows: smaller products cost no less time


class BandedInverse:
    """The inverse of a symmetric positive definite matrix (n, n), factorised in float64.

    Args:
        dtype: of what is solved.
    """

    def __init__(self, matrix: csr_matrix, device: torch.device, dtype: torch.dtype) -> None:
        import scipy.sparse as sparse
        from scipy.sparse.csgraph import reverse_cuthill_mckee

        order = reverse_cuthill_mckee(matrix.tocsr(), symmetric_mode=True).astype(np.int64)
        sorted_ = sparse.coo_matrix(matrix[order][:, order])
        size = max(LEAST_BLOCK, int(np.abs(sorted_.row - sorted_.col).max(initial=0)))
        count = -(-len(order) // size)
        rows, columns, values = sorted_.row, sorted_.col, sorted_.data
        padding = np.arange(len(order), count * size)  # by rows of the identity
        rows, columns = np.concatenate([rows, padding]), np.concatenate([columns, padding])
        values = np.concatenate([values, np.ones(len(padding))])
        blocks = np.zeros((2, count, size, size))  # on the diagonal, and to the left of it
        left = rows // size - columns // size
        lower = left >= 0
        blocks[left[lower], rows[lower] // size, rows[lower] % size, columns[lower] % size] = values[lower]
        inverse, forward, backward = np.zeros((3, count, size, size))
        for block in range(count):
            beside = blocks[1, block] @ inverse[block - 1].T  # zero for the first block
            factor = np.linalg.cholesky(blocks[0, block] - beside @ beside.T)
            inverse[block] = np.linalg.solve(factor, np.eye(size))
            forward[block] = inverse[block] @ beside
            backward[block - 1] = inverse[block - 1].T @ beside.T
        made = (torch.as_tensor(part, device=device).to(dtype) for part in (inverse, forward, backward))
        self._inverse, self._forward, self._backward = made
        self._order = torch.as_tensor(order, device=device)

    def __call__(self, right: Tensor) -> Tensor:
        """Return the solutions (n, M) for right-hand sides (n, M)."""
        count, size = self._inverse.shape[:2]
        padded = right.new_zeros(count * size, right.shape[1])
        padded[: len(right)] = right[self._order]
        y = self._inverse @ padded.view(count, size, -1)
        for block in range(1, count):
            y[block].addmm_(self._forward[block], y[block - 1], alpha=-1)
        y = self._inverse.mT @ y
        for block in range(count - 2, -1, -1):
            y[block].addmm_(self._backward[block], y[block + 1], alpha=-1)
        return torch.empty_like(right).index_copy_(0, self._order, y.flatten(0, 1)[: len(right)])
