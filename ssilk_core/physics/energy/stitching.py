# SPDX-License-Identifier: Apache-2.0
"""Stitches between islands of a garment that lie on one another at rest.

A spring holds a vertex where it lay on a face of another island: at its barycentric coordinates w on the face's plane
and its rest height h over it. With the face's corners x_i and its normal N = (x_1 - x_0) x (x_2 - x_0),

    E = k/2 |x - sum w_i x_i - h n|^2,   n = N / sqrt(|N|^2 + (|N_0| / 1000)^2)

where N_0 is N at rest: the normal of a collapsed face fades instead of turning at random. The offset turns with the
face. A spring of the rest distance alone would let parts swing aside by it, and pass through to the other side.
"""

from __future__ import annotations

from functools import cached_property
from math import sqrt

import numpy as np
import torch
from torch import Tensor

from ...scene.assets import Floats, Ints, Mesh
from ...scene.mesh.stitches import Stitches
from .. import kernels
from ..operators import Entries, SparseOperator
from .bending import cross

FADING = 1e-3  # of the rest normal's length


class Stitching:
    """The springs of S stitches; positions are (V, 3, N).

    Attributes:
        corners: the vertex and the corners of its face, shape (S, 4).
        weights: barycentric coordinates on the face's plane, shape (S, 3, 1).
        stiffness: of each spring [N/m], shape (S, 1).
        height: rest height over the face, for the fading normal [m], shape (S, 1, 1).
    """

    def __init__(
        self, mesh: Mesh, stitches: Stitches, stiffness: Floats, device: torch.device, dtype: torch.dtype
    ) -> None:
        def tensor(values: np.ndarray) -> Tensor:
            return torch.as_tensor(values, dtype=dtype, device=device)

        self.corners = np.column_stack([stitches.vertices, stitches.corners])
        self.weights = tensor(stitches.weights)[:, :, None]
        self.stiffness = tensor(stiffness)[:, None]
        rest = mesh.points[stitches.corners]
        squared = (np.cross(rest[:, 1] - rest[:, 0], rest[:, 2] - rest[:, 0]) ** 2).sum(axis=1)
        self.height = tensor(stitches.height * np.sqrt(1 + FADING**2))[:, None, None]
        self._floor = tensor(FADING**2 * squared)[:, None, None]
        # Rows: what lies between each vertex and its place on the plane, then two edges of the face.
        count = len(stitches)
        values = _entries(torch.as_tensor(stitches.weights)).numpy()
        shape = (3 * count, mesh.vertex_count)
        self._operator = SparseOperator(*self._places(), values, shape, device, dtype)

    def _places(self) -> tuple[Ints, Ints]:
        """Return the rows and columns of the entries of the operator."""
        count = len(self)
        columns = self.corners[:, [0, 1, 2, 3, 2, 1, 3, 1]]
        rows = np.arange(count)[:, None] + count * np.array([0, 0, 0, 0, 1, 1, 2, 2])
        return rows.reshape(-1), columns.reshape(-1)

    @cached_property
    def _at(self) -> Tensor:
        return torch.as_tensor(self.corners, device=self.weights.device)

    @cached_property
    def _filling(self) -> Entries:
        return Entries(*self._places(), self.weights.device)

    def __len__(self) -> int:
        return len(self.corners)

    def take(self, points: Tensor, stiffness: Tensor) -> None:
        """Take another rest shape in place: points (V, 3) [m], and the stiffness of springs at all vertices (V,)."""
        at = self._at
        own, first, second, third = points[at].unbind(1)
        offset, sides = own - first, (second - first, third - first)
        normal = torch.linalg.cross(*sides, dim=1)
        squared = (normal * normal).sum(1)
        shares = [
            (torch.linalg.cross(*pair, dim=1) * normal).sum(1) / squared
            for pair in ((offset, sides[1]), (sides[0], offset))
        ]
        weights = torch.stack([1 - shares[0] - shares[1], *shares], dim=1)
        self.weights.copy_(weights[:, :, None])
        self.stiffness.copy_(stiffness[at[:, 0]][:, None])
        height = (offset * normal).sum(1) / squared.sqrt()
        self.height.copy_((sqrt(1 + FADING**2) * height)[:, None, None])
        self._floor.copy_((FADING**2 * squared)[:, None, None])
        self._filling.fill(self._operator, _entries(weights))

    def energy(self, x: Tensor) -> Tensor:
        """Return the energy [J], shape (N,)."""
        arm, first, second = self.arms(x)
        offset = arm - self.height * self.normal(first, second)[0]
        return (0.5 * self.stiffness * (offset * offset).sum(1)).sum(0)

    def arms(self, x: Tensor) -> tuple[Tensor, ...]:
        """Return x - sum w_i x_i and two edges of the face, from its first corner, each (S, 3, N)."""
        if not kernels.supports(x):
            return self._operator(x).chunk(3)
        from ..kernels.rows import rows_kernel

        return rows_kernel(x, self._operator.matrix, self._operator.transposed).chunk(3)

    def to_vertices(self, arm: Tensor, first: Tensor, second: Tensor) -> Tensor:
        """Return the gradient at the vertices (V, 3, N) from those at the arms (S, 3, N)."""
        return self._operator.adjoint(torch.cat([arm, first, second]))

    def normal(self, first: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
        """Return the fading normal of a face with two edges (S, 3, N), (S, 3, N), and its divisor, (S, 1, N)."""
        across = cross(first, second)
        length = ((across * across).sum(1, keepdim=True) + self._floor).sqrt()
        return across / length, length


def _entries(weights: Tensor) -> Tensor:
    """Return the entries of the operator, from barycentric coordinates (S, 3), shape (8 S,)."""
    edges = weights.new_tensor([1.0, -1, 1, -1]).expand(len(weights), 4)
    return torch.cat([torch.ones_like(weights[:, :1]), -weights, edges], dim=1).reshape(-1)
