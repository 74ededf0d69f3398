# SPDX-License-Identifier: Apache-2.0
"""Products of symmetric block matrices with Jacobians; reference: `simulate.blocks.BlockMatrix.rows`.

A loop owns some rows of blocks of all frames. Its innermost loops run over the columns of the Jacobian.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from .compiling import compiled
from .running import array, run_parts


class BlockRows(NamedTuple):
    """The blocks of a matrix in order of rows.

    Attributes:
        starts: blocks of row r are starts[r] to starts[r + 1], shape (U + 1,).
        columns, stored, transposed: of each block (E,).
    """

    starts: NDArray
    columns: NDArray
    stored: NDArray
    transposed: NDArray


def block_product_loop(blocks: Tensor, rows: BlockRows, jacobian: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Return the product (N, 3 U, m) of a matrix and a Jacobian, and for each column c the sum of w c^2 (N, m).

    Args:
        blocks: stored blocks (stored, 3, 3, N); rows: which make up the matrix.
        jacobian: (N, 3 U, m); weight: w of each vertex (U,).
    """
    product, squares = torch.empty_like(jacobian), jacobian.new_empty(len(jacobian), jacobian.shape[2])
    given = array(blocks), *rows, array(jacobian), array(weight)
    run_parts(_products, len(jacobian), *given, product.numpy(), squares.numpy())
    return product, squares


@compiled
def _products(blocks, starts, columns, stored, transposed, jacobian, weight, product, squares, start, stop):
    width = jacobian.shape[2]
    x, y, z = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.float32)
    total = np.empty(width, np.float32)
    for n in range(start, stop):
        total[:] = 0
        for row in range(len(weight)):
            x[:], y[:], z[:] = 0, 0, 0
            for place in range(starts[row], starts[row + 1]):
                block, at = blocks[stored[place], :, :, n], 3 * columns[place]
                if transposed[place]:
                    block = block.T
                xx, xy, xz = block[0, 0], block[0, 1], block[0, 2]
                yx, yy, yz = block[1, 0], block[1, 1], block[1, 2]
                zx, zy, zz = block[2, 0], block[2, 1], block[2, 2]
                i, j, k = jacobian[n, at], jacobian[n, at + 1], jacobian[n, at + 2]
                for c in range(width):
                    x[c] += xx * i[c] + xy * j[c] + xz * k[c]
                    y[c] += yx * i[c] + yy * j[c] + yz * k[c]
                    z[c] += zx * i[c] + zy * j[c] + zz * k[c]
            own, mine = weight[row], 3 * row
            i, j, k = jacobian[n, mine], jacobian[n, mine + 1], jacobian[n, mine + 2]
            first, second, third = product[n, mine], product[n, mine + 1], product[n, mine + 2]
            for c in range(width):
                total[c] += own * (i[c] * i[c] + j[c] * j[c] + k[c] * k[c])
                first[c], second[c], third[c] = x[c], y[c], z[c]
        squares[n] = total
