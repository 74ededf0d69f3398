# SPDX-License-Identifier: Apache-2.0
"""Preconditioned conjugate gradients, for all frames at once."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

CHECK_EVERY = 8  # iterations between looks at the residuals, which halt a GPU


def inverse_blocks(blocks: Tensor) -> Tensor:
    """Return the inverses of symmetric positive definite blocks (..., 3, 3), by cofactors."""
    a, b, c = blocks.unbind(-2)
    cofactors = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], dim=-1)
    return cofactors / (a * cofactors[..., 0]).sum(-1)[..., None, None].clamp_min(torch.finfo(blocks.dtype).tiny)


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Return the inner product of vectors (N, U, 3) of each frame, shape (N, 1, 1)."""
    return (a * b).sum((1, 2), keepdim=True)


def solve(
    multiply: Callable[[Tensor], Tensor],
    precondition: Callable[[Tensor], Tensor],
    right: Tensor,
    reduction: float,
    iterations: int,
) -> tuple[Tensor, int]:
    """Solve A z = right approximately, from zero.

    Args:
        multiply, precondition: apply A, and roughly its inverse, to (N, U, 3); both positive definite.
        right: shape (N, U, 3).
        reduction: how far the residual has to fall, in the preconditioner's norm.
        iterations: the most that are made.

    Returns:
        z, along which a function with the gradient -right falls, and the number of iterations.
    """
    z, residual = torch.zeros_like(right), right
    step = y = precondition(residual)
    product = dot(residual, y)
    enough = product * reduction**2
    tiny = torch.finfo(right.dtype).tiny
    for done in range(1, iterations + 1):
        image = multiply(step)
        # A frame that has converged takes no more steps: rounding could spoil what it has.
        rate = torch.where(product > enough, product / dot(step, image).clamp_min(tiny), 0)
        z, residual = z + rate * step, residual - rate * image
        y = precondition(residual)
        before, product = product, dot(residual, y)
        step = y + product / before.clamp_min(tiny) * step
        if done % CHECK_EVERY == 0 and not bool((product > enough).any()):
            break
    return z, done
