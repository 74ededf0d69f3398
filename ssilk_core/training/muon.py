# SPDX-License-Identifier: Apache-2.0
"""Muon: steps of matrices along orthogonalised momentum (Jordan et al., "Muon", 2024).

The energy is far stiffer in some directions of a network's output than in others. Adam scales each entry of a matrix
by itself, and comes to the soft directions late. An orthogonalised step is as long in all directions: with the
momentum M = U diag(s) V', it is U V'. A Newton-Schulz iteration makes it of products of matrices alone. PyTorch's
`torch.optim.Muon` is not used because it reads the learning rate on the host, which a captured graph must not, and
cannot skip a step.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

MOMENTUM = 0.95
ITERATIONS = 5
QUINTIC = (3.4445, -4.7750, 2.0315)  # brings singular values from 0.01 to 1 near 1 in few iterations
STEP_SIZE = 0.5  # RMS of the changes of a matrix, in learning rates; Adam's is at most about 1
LEAST_NORM = 1e-30


def orthogonalised(matrix: Tensor) -> Tensor:
    """Return about U V' of a matrix U diag(s) V', shape (rows, columns); its singular values lie in [0.5, 1.5].

    Those of less than about 0.01 of the matrix's norm become smaller. On a GPU products are in bfloat16.
    """
    a, b, c = QUINTIC
    wide = matrix.T if matrix.shape[0] > matrix.shape[1] else matrix
    x = wide / wide.norm().clamp_min(LEAST_NORM)  # so that no singular value exceeds one
    x = x.bfloat16() if x.is_cuda else x
    for _ in range(ITERATIONS):
        square = x @ x.T
        x = a * x + (b * square + c * square @ square) @ x
    x = x.to(matrix.dtype)
    return x.T if matrix.shape[0] > matrix.shape[1] else x


class Muon(torch.optim.Optimizer):
    """Steps of matrices along their orthogonalised momentum.

    Attributes:
        found_inf: one where the next step is to be skipped, else zero, as PyTorch's fused optimisers have it.

    Args:
        groups: of parameters (rows, columns), each with its learning rate "lr", a tensor where steps are captured as
            a graph.
    """

    def __init__(self, groups: Iterable[dict[str, Any]]) -> None:
        super().__init__(groups, {"lr": 0.0})
        self.found_inf: Tensor | None = None

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """Move each matrix W of n rows or columns, whichever are more, by 0.5 sqrt(n) of the learning rate."""
        for group in self.param_groups:
            for matrix in group["params"]:
                if matrix.grad is None:
                    continue
                state = self.state[matrix]
                if not state:
                    state["momentum"] = torch.zeros_like(matrix)
                momentum, gradient = state["momentum"], matrix.grad
                rate = group["lr"] * STEP_SIZE * max(matrix.shape) ** 0.5
                if self.found_inf is not None:
                    gradient = torch.where(self.found_inf > 0, momentum, gradient)
                    rate = rate * (1 - self.found_inf)
                momentum.lerp_(gradient, 1 - MOMENTUM)
                matrix.sub_(rate * orthogonalised(gradient.lerp(momentum, MOMENTUM)))
