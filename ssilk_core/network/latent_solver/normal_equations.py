# SPDX-License-Identifier: Apache-2.0
"""The quadratic model of the energy over the latents, and its damped minimum within bounds."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ...physics import loops
from ...physics.simulate.blocks import BlockMatrix

TINY = 1e-9  # of the mean diagonal, so that what no latent moves stays where it is


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """E(z + s) ~ E + g's + s'Hs / 2 for N frames of m latents, in float64.

    Attributes:
        gradient: J' dE/dx [J], shape (N, m).
        hessian: J' H_x J [J], positive semi-definite, shape (N, m, m).
        inertia: mean over the latents of |dx/dz|^2 m / dt^2 [J], shape (N,).
    """

    gradient: Tensor
    hessian: Tensor
    inertia: Tensor

    @classmethod
    def of(cls, jacobian: Tensor, gradient: Tensor, hessian: BlockMatrix, weight: Tensor) -> NormalEquations:
        """Return those of a Jacobian (N, 3 U, m).

        Args:
            gradient: of the energy at the free vertices [N], shape (U, 3, N).
            hessian: over the free vertices [N/m].
            weight: inertia of the free vertices, m / dt^2 [N/m], shape (U,).
        """
        product, squares = _products(jacobian, hessian, weight.to(jacobian.dtype))
        reduced = (jacobian.mT @ product).double()
        return cls(
            gradient=reduce_forces(jacobian, gradient),
            hessian=0.5 * (reduced + reduced.mT),
            inertia=squares.double().mean(1),
        )

    def steps(self, dampings: Tensor, held: Tensor) -> tuple[Tensor, Tensor]:
        """Return the steps s = -(H + D)^-1 g, and by how much the model says that each lowers the energy [J].

        Args:
            dampings: of T trials, relative to the inertia, shape (T, N).
            held: latents that stay, shape (N, m).

        Returns:
            Steps (T, N, m) and decreases (T, N). Steps are zero where the system has no solution.
        """
        free = (~held).double()
        hessian = self.hessian * free[:, :, None] * free[:, None] + torch.diag_embed(held.double())
        gradient = self.gradient * free
        diagonal = self.hessian.diagonal(dim1=1, dim2=2).mean(1)
        shift = dampings.double() * self.inertia + TINY * diagonal + torch.finfo(torch.float64).tiny
        damped = hessian + shift[..., None, None] * torch.eye(free.shape[1], dtype=free.dtype, device=free.device)
        factor, failed = torch.linalg.cholesky_ex(damped)
        step = -torch.cholesky_solve(gradient.expand(len(dampings), -1, -1)[..., None], factor)[..., 0]
        step = torch.where((failed == 0)[..., None] & step.isfinite(), step, 0) * free
        # s'Hs = -g's - shift s's, since s solves the system.
        return step, 0.5 * (shift * step.square().sum(-1) - (gradient * step).sum(-1))


def reduce_forces(jacobian: Tensor, gradient: Tensor) -> Tensor:
    """Return J' g (N, m), in float64, of a Jacobian (N, 3 U, m) and a gradient (U, 3, N)."""
    return (jacobian.mT @ gradient.permute(2, 0, 1).flatten(1)[..., None])[..., 0].double()


def _products(jacobian: Tensor, hessian: BlockMatrix, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Return H_x J (N, 3 U, m), and |dx/dz|^2 of each latent weighted by vertices (N, m)."""
    if loops.supports(jacobian):
        from ...physics.loops.block_products import block_product_loop

        return block_product_loop(hessian.blocks, hessian.pattern.block_rows, jacobian, weight)
    product = hessian.rows.to(jacobian.dtype) @ jacobian.flatten(0, 1)
    return product.view_as(jacobian), weight.repeat_interleave(3) @ jacobian.square()
