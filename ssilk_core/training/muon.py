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


def orthogonalised(matrices: Tensor) -> Tensor:
    """Return about U V' of each matrix U diag(s) V', (N, rows, columns); their singular values lie in [0.5, 1.5].

    Those of less than about 0.01 of a matrix's norm become smaller. On a GPU products are in bfloat16.
    """
    a, b, c = QUINTIC
    is_tall = matrices.shape[1] > matrices.shape[2]
    wide = matrices.mT if is_tall else matrices
    x = wide / wide.norm(dim=(1, 2), keepdim=True).clamp_min(LEAST_NORM)  # so that no singular value exceeds one
    x = x.bfloat16() if x.is_cuda else x
    for _ in range(ITERATIONS):
        square = x @ x.mT
        x = torch.baddbmm(x, torch.baddbmm(square, square, square, beta=b, alpha=c), x, beta=a)
    x = x.to(matrices.dtype)
    return x.mT if is_tall else x


class Muon(torch.optim.Optimizer):
    """Steps of matrices along their orthogonalised momentum; those of one shape are taken together.

    Attributes:
        found_inf: one where the next step is to be skipped, else zero, as PyTorch's fused optimisers have it.

    Args:
        groups: of parameters (rows, columns), each with its learning rate "lr", a tensor where steps are captured as
            a graph, and its "weight_decay", relative to that rate (Loshchilov and Hutter, 2019).
    """

    def __init__(self, groups: Iterable[dict[str, Any]]) -> None:
        super().__init__(groups, {"lr": 0.0, "weight_decay": 0.0})
        self.found_inf: Tensor | None = None

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        """Move each matrix W of n rows or columns, whichever are more, by 0.5 sqrt(n) of the learning rate.

        Before that W shrinks to (1 - rate * decay) W.
        """
        for group in self.param_groups:
            alike: dict[torch.Size, list[Tensor]] = {}
            for matrix in group["params"]:
                if matrix.grad is not None:
                    alike.setdefault(matrix.shape, []).append(matrix)
            for shape, matrices in alike.items():
                rate = group["lr"] if self.found_inf is None else group["lr"] * (1 - self.found_inf)
                kept, length = 1 - rate * group["weight_decay"], rate * STEP_SIZE * max(shape) ** 0.5
                directions = orthogonalised(torch.stack([self._ahead(matrix) for matrix in matrices]))
                for matrix, direction in zip(matrices, directions):
                    matrix.mul_(kept).sub_(length * direction)

    def _ahead(self, matrix: Tensor) -> Tensor:
        """Update a matrix's momentum; return what the next one would be with the same gradient (Nesterov)."""
        state, gradient = self.state[matrix], matrix.grad
        assert gradient is not None
        if not state:
            state["momentum"] = torch.zeros_like(matrix)
        momentum = state["momentum"]
        if self.found_inf is not None:
            gradient = torch.where(self.found_inf > 0, momentum, gradient)
        momentum.lerp_(gradient, 1 - MOMENTUM)
        return gradient.lerp(momentum, MOMENTUM)
