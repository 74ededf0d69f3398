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

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ..assets import Floats, Mesh
from ..config import MOST_SMOOTHED_VERTICES
from ..mesh import topology
from ..model.network import GarmentModel

EDGE_WEIGHT = 1 / np.sqrt(3)  # cotangent weight of an edge between equilateral triangles
LEAST_AREA = 1e-6  # of a vertex, relative to the mean: one without faces has none, and moves by itself


class ShapeSmoothing:
    """Turns a step of an optimiser on blendshapes B into one on U, with B = S U.

    Args:
        shapes: the blendshapes B [m], shape (V', 3, K).
        mesh: garment; `free`: its V' vertices that B moves, shape (V',). The others stay where they are.
        length: l [m].
    """

    @classmethod
    def of(cls, model: GarmentModel, relative: float) -> ShapeSmoothing | None:
        """Return that of a model, with l relative to the diagonal of the garment's bounding box.

        None for a length of zero, without blendshapes, or for more vertices than fit.
        """
        decoder = model.decoder
        length = relative * float(np.linalg.norm(np.ptp(model.scene.garment.mesh.points, axis=0)))
        if not length or not decoder.shapes.numel() or len(decoder.free) > MOST_SMOOTHED_VERTICES:
            return None
        return cls(decoder.shapes, model.scene.garment.mesh, decoder.free, length)

    def __init__(self, shapes: nn.Parameter, mesh: Mesh, free: Tensor, length: float) -> None:
        self.shapes = shapes
        stiffness, area = laplacian(mesh)
        chosen = free.cpu().numpy()

        def tensor(values: Floats) -> Tensor:
            return torch.as_tensor(values, dtype=torch.float64, device=shapes.device)

        areas = tensor(area[chosen]).diag()
        system = areas + length**2 * tensor(stiffness[chosen][:, chosen].toarray())
        self.matrix = torch.linalg.solve(system, areas).to(shapes.dtype)
        self._before = torch.empty_like(shapes)

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


def laplacian(mesh: Mesh) -> tuple[Any, Floats]:
    """Return the stiffness K, sparse (V, V), and the areas [m2] of the vertices (V,).

    All edges have the weight of equilateral triangles: slivers then weigh no more than others.
    """
    from scipy.sparse import coo_array, diags_array

    pairs = topology.edges(mesh.faces)
    rows, columns = np.concatenate([pairs, pairs[:, ::-1]]).T
    joined = coo_array((np.full(len(rows), EDGE_WEIGHT), (rows, columns)), shape=(mesh.vertex_count,) * 2).tocsr()
    area = topology.vertex_areas(mesh.points, mesh.faces)
    return diags_array(joined.sum(axis=1)).tocsr() - joined, np.maximum(area, LEAST_AREA * area.mean())
