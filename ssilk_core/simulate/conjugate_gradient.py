# SPDX-License-Identifier: Apache-2.0
"""Preconditioned conjugate gradients, for all frames at once."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

ROUNDING = 4  # units in the last place that sums of element blocks may be off by
CHECK_EVERY = 8  # iterations between looks at the residuals, which halt a GPU


def inverse_blocks(blocks: Tensor) -> Tensor:
    """Return the inverses of symmetric blocks (..., 3, 3), positive definite, by cofactors in float64.

    The determinants of blocks at slivers overflow in single precision. Rounding may have left such blocks indefinite:
    what it may have taken is added first. To a block that is indefinite by itself its norm is added, which leaves it
    definite.
    """
    wide, eye = blocks.double(), torch.eye(3, dtype=torch.float64, device=blocks.device)
    largest = wide.diagonal(dim1=-2, dim2=-1).amax(-1)[..., None, None]
    wide = wide + ROUNDING * torch.finfo(blocks.dtype).eps * largest.abs() * eye
    wide = wide + torch.where(_definite(wide), 0, wide.square().sum((-2, -1)).sqrt())[..., None, None] * eye
    cofactors, determinant = _cofactors(wide)
    return (cofactors / determinant.clamp_min(torch.finfo(torch.float64).tiny)[..., None, None]).to(blocks.dtype)


def _cofactors(blocks: Tensor) -> tuple[Tensor, Tensor]:
    """Return the cofactors of symmetric blocks (..., 3, 3) and their determinants (...)."""
    a, b, c = blocks.unbind(-2)
    cofactors = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], dim=-1)
    return cofactors, (a * cofactors[..., 0]).sum(-1)


def _definite(blocks: Tensor) -> Tensor:
    """Return which symmetric blocks (..., 3, 3) are positive definite, by their leading minors, shape (...)."""
    cofactors, determinant = _cofactors(blocks)
    return (blocks[..., 0, 0] > 0) & (cofactors[..., 2, 2] > 0) & (determinant > 0)


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
        # Neither does one whose matrix rounding has left indefinite: it keeps the way down that it has. From then on
        # their product is zero, so that they end.
        curvature = dot(step, image)
        moves = (product > enough) & (curvature > 0)
        rate = torch.where(moves, product / curvature.clamp_min(tiny), 0)
        z, residual = z + rate * step, residual - rate * image
        y = precondition(residual)
        before, product = product, torch.where(moves, dot(residual, y), 0)
        step = y + product / before.clamp_min(tiny) * step
        if done % CHECK_EVERY == 0 and not bool((product > enough).any()):
            break
    return z, done
