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

import numpy as np
import torch
from torch import Tensor, nn

from ..network.model.network import GarmentModel
from ..scene.assets import Mesh
from ..scene.mesh.laplacian import cotangent_weights, laplacian
from ..scene.mesh.topology import edges, vertex_areas
from .settings import MOST_SMOOTHED_VERTICES

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
        stiffness = laplacian(pairs, weights, mesh.vertex_count)
        area = vertex_areas(mesh.points, mesh.faces)
        area = np.maximum(area, LEAST_AREA * area.mean())
        areas = torch.as_tensor(area[chosen], device=shapes.device)
        system = torch.as_tensor(length**2 * stiffness[chosen][:, chosen].toarray(), device=shapes.device)
        system.diagonal().add_(areas)
        self.matrix = (torch.linalg.inv(system) * areas).to(shapes.dtype)
        self._before = torch.empty_like(shapes)
        if shapes.is_cuda:  # what is cached counts as taken where the batch is fitted to the free memory
            del system
            torch.cuda.empty_cache()

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

    @torch.no_grad()
    def smooth_start(self) -> None:
        """Smooth the random blendshapes that training starts with, and keep their RMS.

        No smoothed step could take their shortest waves away again.
        """
        smooth = (self.matrix @ self.shapes.flatten(1)).view_as(self.shapes)
        self.shapes.copy_(smooth * (self.shapes.norm() / smooth.norm()))

    @torch.no_grad()
    def before_step(self) -> None:
        """Turn the gradient with respect to B into that with respect to U, S^T grad."""
        assert self.shapes.grad is not None
        self._before.copy_(self.shapes)
        self.shapes.grad.copy_((self.matrix.T @ self.shapes.grad.flatten(1)).view_as(self.shapes))

    @torch.no_grad()
    def after_step(self) -> None:
        """Turn the optimiser's change of B, which was meant for U, into that of B."""
        change = (self.shapes - self._before).flatten(1)
        self.shapes.copy_(self._before + (self.matrix @ change).view_as(self.shapes))
