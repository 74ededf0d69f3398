# SPDX-License-Identifier: Apache-2.0
"""Conjugate gradients by kernels against the reference implementation, on blocks of random sparsity."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ssilk_core.physics.kernels.conjugate_gradient import solve_kernel
from ssilk_core.physics.simulate.blocks import BlockMatrix, BlockPattern
from ssilk_core.physics.simulate.conjugate_gradient import CHECK_EVERY, inverse_blocks

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")  # the interpreter runs kernels on a CPU


def random_matrix(vertices: int, frames: int) -> BlockMatrix:
    """Diagonally dominant blocks between random pairs of all but every fifth vertex."""
    rng = np.random.default_rng(vertices)
    free = np.flatnonzero(np.arange(vertices) % 5)
    pattern = BlockPattern(rng.integers(0, vertices, (3 * vertices, 2)), free, vertices, DEVICE)
    blocks = rng.normal(size=(pattern.block_count, 3, 3, frames))
    blocks[: pattern.count] += blocks[: pattern.count].transpose(0, 2, 1, 3) + 40 * np.eye(3)[:, :, None]
    return BlockMatrix(pattern, torch.as_tensor(blocks, dtype=torch.float32, device=DEVICE))


def by_kernel(
    matrix: BlockMatrix, right: torch.Tensor, reduction: float, iterations: int
) -> tuple[torch.Tensor, int]:
    diagonal = matrix.blocks[: matrix.pattern.count].permute(3, 0, 1, 2)
    inverse = inverse_blocks(diagonal.contiguous()).permute(1, 2, 3, 0)
    return solve_kernel(matrix.blocks, matrix.pattern.table, inverse, right, reduction, iterations, CHECK_EVERY)


@pytest.mark.parametrize("frames", [1, 3, 40])  # less than a program's, and more
def test_the_kernel_solves_as_dense_algebra_does(frames) -> None:
    matrix = random_matrix(30, frames)
    right = torch.randn(matrix.pattern.count, 3, frames, generator=torch.Generator().manual_seed(1)).to(DEVICE)
    found, _ = by_kernel(matrix, right, 1e-6, 48)
    dense = matrix.rows.to_dense().double()
    expected = torch.linalg.solve(dense, right.permute(2, 0, 1).reshape(-1).double())
    torch.testing.assert_close(found.permute(2, 0, 1).reshape(-1).double(), expected, rtol=1e-4, atol=1e-6)


def test_the_kernel_stops_where_the_reference_does(monkeypatch) -> None:
    monkeypatch.setattr("ssilk_core.physics.kernels.available", lambda device: False)
    matrix = random_matrix(25, 5)
    right = torch.randn(matrix.pattern.count, 3, 5, generator=torch.Generator().manual_seed(2)).to(DEVICE)
    right[..., 2] = 0  # a frame that is solved from the start
    matrix.blocks[matrix.pattern.count :, ..., 3] *= 40  # and one that is indefinite
    for reduction, iterations in ((0.1, 200), (1e-9, 5)):
        expected, count = matrix.solve(right, reduction, iterations)
        found, steps = by_kernel(matrix, right, reduction, iterations)
        assert steps == count
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-6)
