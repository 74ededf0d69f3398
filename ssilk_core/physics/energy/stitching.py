# SPDX-License-Identifier: Apache-2.0
"""Stitches between islands of a garment that lie on one another at rest.

A spring holds a vertex where it lay on a face of another island: at its barycentric coordinates w on the face's plane
and its rest height h over it. With the face's corners x_i and its normal N = (x_1 - x_0) x (x_2 - x_0),

    E = k/2 |x - sum w_i x_i - h n|^2,   n = N / sqrt(|N|^2 + (|N_0| / 1000)^2)

where N_0 is N at rest: the normal of a collapsed face fades instead of turning at random. The offset turns with the
face. A spring of the rest distance alone would let parts swing aside by it, and pass through to the other side.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ...scene.assets import PINNED, Floats, Ints, Mesh
from ...scene.fabrics import Fabric
from ...scene.mesh.stitches import NONE, Stitches, find_stitches
from .. import kernels
from ..operators import SparseOperator
from .bending import cross

FADING = 1e-3  # of the rest normal's length


def held_stitches(mesh: Mesh, fabric: Fabric, classes: Ints | None) -> Stitches:
    """Return the stitches of a garment, without those between pinned vertices alone, which hold anyway."""
    if not fabric.stitch:
        return NONE
    found = find_stitches(mesh)
    if classes is None:
        return found
    moves = np.column_stack([found.vertices, found.corners])
    return found.select((classes[moves] != PINNED).any(axis=1))


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
        edges = np.tile([1.0, -1, 1, -1], (count, 1))
        values = np.column_stack([np.ones(count), -stitches.weights, edges])
        columns = self.corners[:, [0, 1, 2, 3, 2, 1, 3, 1]]
        rows = np.arange(count)[:, None] + count * np.array([0, 0, 0, 0, 1, 1, 2, 2])
        shape = (3 * count, mesh.vertex_count)
        self._operator = SparseOperator(
            rows.reshape(-1), columns.reshape(-1), values.reshape(-1), shape, device, dtype
        )

    def __len__(self) -> int:
        return len(self.corners)

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
