# SPDX-License-Identifier: Apache-2.0
"""Preconditioned conjugate gradients, for all frames at once."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

ROUNDING = 4  # rounding error of summed element blocks, in units in the last place
CHECK_EVERY = 8  # iterations between convergence checks, which synchronise with a GPU


def inverse_blocks(blocks: Tensor) -> Tensor:
    """Return the inverses of symmetric positive definite blocks (..., 3, 3), by cofactors in float64.

    The determinants of blocks at slivers overflow in single precision. Rounding errors may make such blocks
    indefinite, so a bound of the error is added to the diagonal first. Blocks that are indefinite even so get their
    norm added, which makes them definite.
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
        multiply, precondition: apply A, and an approximate inverse, to (N, U, 3); both positive definite.
        right: right-hand side, shape (N, U, 3).
        reduction: factor by which the residual must fall, in the preconditioner's norm.
        iterations: maximum number of iterations.

    Returns:
        z, a descent direction of a function with the gradient -right, and the number of iterations.
    """
    z, residual = torch.zeros_like(right), right
    step = y = precondition(residual)
    product = dot(residual, y)
    enough = product * reduction**2
    tiny = torch.finfo(right.dtype).tiny
    for done in range(1, iterations + 1):
        image = multiply(step)
        # Converged frames take no more steps, because rounding could spoil their solution. Neither do frames whose
        # matrix is indefinite through rounding: they keep their descent direction.
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
