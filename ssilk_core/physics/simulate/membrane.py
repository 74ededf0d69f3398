# SPDX-License-Identifier: Apache-2.0
"""Energy, gradient and positive semi-definite Hessian of the membrane, for either stretch model.

Both models have a first Piola-Kirchhoff stress P = F S with a symmetric 2 x 2 matrix S. Their Hessian is the
geometric part S (x) I, indefinite under compression, plus a positive semi-definite material part, a sum of outer
products of the columns w_u, w_v of F:

    M_uu = a w_u w_u' + b w_v w_v',   M_vv = c w_v w_v' + b w_u w_u',   M_uv = d w_u w_v' + b w_v w_u'

Clamping the eigenvalues of S, the second Piola-Kirchhoff stress, at zero makes the sum positive semi-definite.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ...scene.assets import Ints, Mesh
from ...scene.fabrics import Fabric
from ..energy.stretch import deformation_gradient_operator, stretch_density, stretched_areas

Symmetric = tuple[Tensor, Tensor, Tensor]  # entries uu, uv, vv of 2 x 2 matrices, each (F, N)
MIN_SQUARED_LENGTH = 1e-12  # floor for squared column lengths, as in the density


class Membrane:
    """The stretch energy of a garment; positions (V, 3, N), one result for each of N frames.

    Attributes:
        corners: vertices of each triangle in ascending order, shape (F, 3).
        weights: of these in both columns of F [1/m], shape (2, F, 3).
    """

    def __init__(self, mesh: Mesh, fabric: Fabric, device: torch.device, dtype: torch.dtype) -> None:
        self.fabric = fabric
        self.operator = deformation_gradient_operator(mesh, device, dtype)
        # A row of the operator has a face's corners in ascending order of vertex indices.
        matrix = self.operator.matrix
        self.corners: Ints = matrix.col_indices().cpu().numpy().reshape(2, -1, 3)[0]
        self.weights = matrix.values().reshape(2, -1, 3)
        self.area = torch.as_tensor(stretched_areas(mesh), dtype=dtype, device=device)[:, None]

    def energy(self, x: Tensor) -> Tensor:
        """Return the energy [J], shape (N,)."""
        return (self.area * stretch_density(self.operator(x), self.fabric)).sum(0)

    def gradient(self, x: Tensor) -> Tensor:
        """Return the gradient [N], shape (V, 3, N)."""
        return self.operator.adjoint(self._pull(x))

    def corner_forces(self, x: Tensor) -> Tensor:
        """Return the gradient of each triangle's energy at its `corners` [N], shape (F, 3, 3, N)."""
        return torch.einsum("kfi,kfan->fian", self.weights, self._pull(x).unflatten(0, (2, -1)))

    def _pull(self, x: Tensor) -> Tensor:
        """Return the gradient in the columns of F [J], shape (2 F, 3, N)."""
        w_u, w_v = self.operator(x).chunk(2)
        uu, uv, vv = ((self.area * s)[:, None] for s in second_piola_kirchhoff(w_u, w_v, self.fabric))
        return torch.cat([uu * w_u + uv * w_v, uv * w_u + vv * w_v])

    def stiffness(self, x: Tensor, exact_hessian: Tensor | None = None) -> Tensor:
        """Return the positive semi-definite Hessian in the columns of F [J], float32.

        The blocks uu, uv, vu, vv follow each other: (4 F, 3, 3, N).

        Args:
            exact_hessian: frames that use the exact Hessian, which compression may make indefinite, shape (N,).
        """
        w_u, w_v = self.operator(x).float().chunk(2)
        stresses = second_piola_kirchhoff(w_u, w_v, self.fabric)
        clamped = project_psd(*stresses)
        if exact_hessian is None:
            exact_hessian = torch.zeros_like(clamped[0][0], dtype=torch.bool)
        uu, uv, vv = (torch.where(exact_hessian, own, other)[:, None, None] for own, other in zip(stresses, clamped))
        a, b, c, d = material(w_u, w_v, self.fabric)
        identity = torch.eye(3, device=x.device)[:, :, None]
        own_u, own_v, mixed = outer(w_u, w_u), outer(w_v, w_v), outer(w_u, w_v)
        off = uv * identity + d * mixed + b * mixed.transpose(1, 2)
        blocks = [
            uu * identity + a * own_u + b * own_v,
            off,
            off.transpose(1, 2),
            vv * identity + c * own_v + b * own_u,
        ]
        area = self.area.float()[:, None, None]
        return torch.cat([area * block for block in blocks])


def outer(a: Tensor, b: Tensor) -> Tensor:
    """Return the outer products a b' of vectors (M, 3, N), shape (M, 3, 3, N)."""
    return a[:, :, None] * b[:, None]


def second_piola_kirchhoff(w_u: Tensor, w_v: Tensor, fabric: Fabric) -> Symmetric:
    """Return the second Piola-Kirchhoff stress S of P = F S for each triangle [N/m].

    The columns of F are w_u and w_v, shape (F, 3, N).
    """
    uu, uv, vv = (w_u * w_u).sum(1), (w_u * w_v).sum(1), (w_v * w_v).sum(1)
    if fabric.stretch_model == "stvk":
        trace = 0.5 * fabric.lame_lambda * (uu + vv - 2)
        return fabric.lame_mu * (uu - 1) + trace, fabric.lame_mu * uv, fabric.lame_mu * (vv - 1) + trace
    length_u, length_v = uu.clamp_min(MIN_SQUARED_LENGTH).sqrt(), vv.clamp_min(MIN_SQUARED_LENGTH).sqrt()
    return 2 * fabric.stretch * (1 - 1 / length_u), 2 * fabric.shear * uv, 2 * fabric.stretch * (1 - 1 / length_v)


def material(w_u: Tensor, w_v: Tensor, fabric: Fabric) -> tuple[Tensor | float, float, Tensor | float, float]:
    """Return a, b, c and d of the material part (see the module), numbers or tensors that broadcast to blocks."""
    if fabric.stretch_model == "stvk":
        along = 2 * fabric.lame_mu + fabric.lame_lambda
        return along, fabric.lame_mu, along, fabric.lame_lambda
    a, c = (
        2 * fabric.stretch * (w * w).sum(1).clamp_min(MIN_SQUARED_LENGTH)[:, None, None] ** -1.5 for w in (w_u, w_v)
    )
    return a, 2 * fabric.shear, c, 0.0


def project_psd(uu: Tensor, uv: Tensor, vv: Tensor) -> Symmetric:
    """Return the nearest positive semi-definite matrices, by clamping eigenvalues m +- r at zero."""
    m, half = 0.5 * (uu + vv), 0.5 * (uu - vv)
    r = (half * half + uv * uv).sqrt()
    low, high = (m - r).clamp_min(0), (m + r).clamp_min(0)
    mean, slope = 0.5 * (high + low), 0.5 * (high - low) / r.clamp_min(torch.finfo(r.dtype).tiny)
    return mean + slope * half, slope * uv, mean - slope * half
