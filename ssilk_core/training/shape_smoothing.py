# SPDX-License-Identifier: Apache-2.0
"""Smooth updates of blendshapes.

Adam moves every coordinate of every blendshape by about the learning rate, each with its own noise. The sum over many
shapes crumples cloth within a thousand steps, and crumpled cloth stays so: a fold can only leave through states that
stretch more. So each blendshape is B = S U, and Adam's steps are those of U, with

    S = (M + l^2 K)^-1 M,

the areas M of the vertices and the stiffness K of the surface. A wave of length L changes at 1 / (1 + (2 pi l / L)^2)
of the rate of a flat displacement. The paper does not smooth; Nicolet et al., "Large Steps in Inverse Rendering of
Geometry" (2021), take the same parametrisation for meshes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor, nn

from ..network.model.network import GarmentModel
from ..scene.assets import Floats, Mesh
from ..scene.mesh.laplacian import cotangent_weights, laplacian
from ..scene.mesh.topology import edges, vertex_areas
from .banded_inverse import BandedInverse
from .settings import MOST_SMOOTHED_VERTICES

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

COTANGENTS = (0.0, 5.0)  # bounds of the edge weights: S must not overshoot, and slivers must not weigh more
LEAST_AREA = 1e-6  # of a vertex, relative to the mean: one without faces has none, and moves by itself


class ShapeSmoothing:
    """Turns a step of an optimiser on blendshapes B into one on U, with B = S U.

    Args:
        shapes: the blendshapes B [m], shape (V', 3, K).
        mesh: garment.
        free: its V' vertices that B moves, shape (V',). The others stay where they are.
        length: l [m].
    """

    def __init__(self, shapes: nn.Parameter, mesh: Mesh, free: Tensor, length: float) -> None:
        self.shapes = shapes
        pairs, chosen = edges(mesh.faces), free.cpu().numpy()
        weights = cotangent_weights(mesh.points, mesh.faces, pairs, COTANGENTS)
        stiffness = laplacian(pairs, weights, mesh.vertex_count)[chosen][:, chosen]
        area = vertex_areas(mesh.points, mesh.faces)
        mean = area.mean()
        area = np.maximum(area / mean, LEAST_AREA)[chosen]
        self._areas = torch.as_tensor(area, device=shapes.device).to(shapes.dtype)[:, None]
        self._inverse = _inverse(stiffness, area, length**2 / mean, shapes)
        self._before = torch.empty_like(shapes)

    @classmethod
    def of(cls, model: GarmentModel, relative: float) -> ShapeSmoothing | None:
        """Return that of a model, with l relative to the diagonal of the garment's bounding box.

        None for a length of zero, without blendshapes, or for more than `MOST_SMOOTHED_VERTICES` free vertices.
        """
        decoder = model.decoder
        if not relative or not decoder.shapes.numel() or len(decoder.free) > MOST_SMOOTHED_VERTICES:
            return None
        mesh = model.scene.garment.mesh
        return cls(decoder.shapes, mesh, decoder.free, relative * mesh.diagonal)

    def smooth(self, values: Tensor) -> Tensor:
        """Return S times values of the V' vertices, (V', ...) of the same shape."""
        return self._inverse(self._areas * values.flatten(1)).view_as(values)

    @torch.no_grad()
    def smooth_start(self) -> None:
        """Smooth the random blendshapes that training starts with, and keep their RMS.

        No smoothed step could take their shortest waves away again.
        """
        smooth = self.smooth(self.shapes)
        self.shapes.copy_(smooth * (self.shapes.norm() / smooth.norm()))

    @torch.no_grad()
    def before_step(self) -> None:
        """Turn the gradient with respect to B into that with respect to U, S^T grad."""
        assert self.shapes.grad is not None
        self._before.copy_(self.shapes)
        self.shapes.grad.copy_((self._areas * self._inverse(self.shapes.grad.flatten(1))).view_as(self.shapes))

    @torch.no_grad()
    def after_step(self) -> None:
        """Turn the optimiser's change of B, which was meant for U, into that of B."""
        self.shapes.copy_(self._before + self.smooth(self.shapes - self._before))


def _inverse(stiffness: csr_matrix, area: Floats, factor: float, like: Tensor) -> Callable[[Tensor], Tensor]:
    """Return what multiplies matrices (V', M) by (diag(area) + factor * stiffness)^-1, in the precision of `like`."""
    import scipy.sparse as sparse

    system = (factor * stiffness + sparse.diags(area)).tocsr()
    if not like.is_cuda:
        return BandedInverse(system, like.device, like.dtype)
    # One product of matrices is a launch; a sequence of small ones would be hundreds.
    dense = torch.linalg.inv(torch.as_tensor(system.toarray(), device=like.device)).to(like.dtype)
    torch.cuda.empty_cache()  # what is cached counts as taken where the batch is fitted to the free memory
    return dense.matmul
