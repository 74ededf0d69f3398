# SPDX-License-Identifier: Apache-2.0
"""Tables of the rest shape for the elastic kernels: one row for each corner of each triangle, and for each hinge."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ...scene.assets import Floats, Ints
from ...scene.mesh import topology


@dataclass(frozen=True, eq=False)
class ElasticTables:
    """The rest shape in the layout of the kernels; indices are int32, numbers float32.

    The row of a corner turns its triangle (a, b, c) so that the corner comes first. Its indices (6,) are a, b, c and
    the hinges on ab, bc, ca; its numbers (8,) the weights of b in both columns of F, those of c, the rest area, and
    for ab, bc, ca whether the hinge's normal on this side is the triangle's, 1, or its opposite, -1. An edge without
    a hinge has the hinge 0 and the number 0.

    Attributes:
        starts: the corners at vertex v are rows starts[v] to starts[v + 1], shape (V + 1,).
        corners, corner_numbers: every corner, ordered by vertex, shapes (3 F, 6) and (3 F, 8).
        faces, face_numbers: the first corner of every triangle, shapes (F, 6) and (F, 8).
        hinges: vertices as in `topology.hinges`, shape (H, 4).
        hinge_numbers: stiffness [J] and rest angle [rad], shape (H, 2).
        order: the corners of all triangles, first ones first, in the order of `corners`, shape (3 F,).
    """

    starts: Tensor
    corners: Tensor
    corner_numbers: Tensor
    faces: Tensor
    face_numbers: Tensor
    hinges: Tensor
    hinge_numbers: Tensor
    order: Tensor

    def take(self, weights: Tensor, areas: Tensor, hinge_numbers: Tensor) -> None:
        """Take another rest shape in place; arguments are those of `elastic_tables`, as tensors."""
        turns = [torch.cat([weights[:, (1 + t) % 3], weights[:, (2 + t) % 3], areas[:, None]], 1) for t in range(3)]
        self.face_numbers[:, :5] = turns[0]
        self.corner_numbers[:, :5] = torch.cat(turns)[self.order]
        self.hinge_numbers.copy_(hinge_numbers)


def elastic_tables(
    vertex_count: int, faces: Ints, weights: Floats, areas: Floats, hinges: Ints, hinge_numbers: Tensor
) -> ElasticTables:
    """Build the tables of a mesh on the device of `hinge_numbers`.

    Args:
        faces: (F, 3); weights: of their corners in both columns of F (F, 3, 2); areas: at rest (F,).
        hinges: hinges that resist bending (H, 4), with their `hinge_numbers` (H, 2).
    """
    edge_hinges, signs = _hinges_of_edges(faces, hinges)
    rows, numbers = [], []
    for turn in range(3):
        corner, weight, hinge, sign = (
            np.roll(values, -turn, axis=1) for values in (faces, weights, edge_hinges, signs)
        )
        rows.append(np.hstack([corner, hinge]))
        numbers.append(np.hstack([weight[:, 1], weight[:, 2], areas[:, None], sign]))
    order = np.argsort(faces.T.reshape(-1), kind="stable")
    starts = np.searchsorted(np.sort(faces.reshape(-1)), np.arange(vertex_count + 1))

    def tensor(values: np.ndarray, dtype: torch.dtype) -> Tensor:
        return torch.tensor(values, dtype=dtype, device=hinge_numbers.device)

    return ElasticTables(
        tensor(starts, torch.int32),
        tensor(np.concatenate(rows)[order], torch.int32),
        tensor(np.concatenate(numbers)[order], torch.float32),
        tensor(rows[0], torch.int32),
        tensor(numbers[0], torch.float32),
        tensor(hinges, torch.int32),
        hinge_numbers.float().contiguous(),
        tensor(order, torch.int64),
    )


def _hinges_of_edges(faces: Ints, hinges: Ints) -> tuple[Ints, Floats]:
    """Return the hinges at the edges ab, bc, ca of the triangles and the signs of their normals, else 0; (F, 3)."""
    half = topology.half_edges(faces)
    keys = topology.edge_keys(np.concatenate([half, hinges[:, :2]]))
    _, first, edge = np.unique(keys, return_index=True, return_inverse=True)
    hinge = np.full(len(first), -1)
    hinge[edge[len(half) :]] = np.arange(len(hinges))
    edge = edge[: len(half)]
    hinge, first = hinge[edge], first[edge]
    # The first triangle on an edge has the hinge's normal; so has the other one if it traverses the edge backwards.
    agrees = (first == np.arange(len(half))) | (half[:, 0] != half[first, 0])
    sign = np.where(hinge >= 0, np.where(agrees, 1.0, -1.0), 0.0)
    return np.maximum(hinge, 0).reshape(-1, 3), sign.reshape(-1, 3)
