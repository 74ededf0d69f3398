# SPDX-License-Identifier: Apache-2.0
"""Linear blend skinning: sparse in kernels and loops where they serve, else one dense matrix product over joints.

Layouts keep frames last: matrices (joints, 3, 4, N) take the bind pose to the posed world, positions are (V, 3, N).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from ..scene.assets import Ints, SkinWeights
from . import kernels, loops

PARTS = 16  # programs that share the gradient of a joint's matrix, so that few joints use a whole GPU


def blend_matrices(weights: Tensor, matrices: Tensor) -> Tensor:
    """Blend skinning matrices (J, 3, 4, N) by dense weights (V, J) to one for each vertex, (V, 3, 4, N)."""
    return (weights @ matrices.flatten(1)).reshape(-1, *matrices.shape[1:])


def transform_points(affine: Tensor, points: Tensor) -> Tensor:
    """Apply an affine transform (V, 3, 4, N) to each point (V, 3, N or 1); returns (V, 3, N)."""
    return transform_directions(affine, points) + affine[:, :, 3]


def transform_directions(affine: Tensor, directions: Tensor) -> Tensor:
    """Apply the linear part of an affine transform (V, 3, 4, N) to each direction (V, 3, N or 1)."""
    return (affine[:, :, :3] * directions[:, None]).sum(2)


class Skinning(nn.Module):
    """Linear blend skinning of one mesh.

    Args:
        skin: joints and weights of each vertex; zero weights mean no influence.
        trainable: consecutive joints whose matrices may have a gradient; all others are constant.

    Attributes:
        weights: those of `skin`, shape (V, I).
        used: joints that move any vertex; the columns of dense weights.
    """

    weights: Tensor
    used: Tensor
    columns: Tensor
    joints: Tensor
    counts: Tensor
    entries: Tensor
    starts: Tensor

    def __init__(self, skin: SkinWeights, trainable: range = range(0)) -> None:
        super().__init__()
        support = skin.weights > 0
        used = np.unique(skin.indices[support])
        self.first_trainable = trainable.start
        entries, starts = by_joint(skin.indices, support, trainable)
        constants = {
            "weights": skin.weights.astype(np.float32),
            "used": used.astype(np.int64),
            "columns": np.searchsorted(used, skin.indices).clip(max=len(used) - 1),
            "joints": skin.indices.copy(),
            # Influences after a vertex's last one are skipped; other zero weights add nothing.
            "counts": (support.shape[1] - support[:, ::-1].argmax(axis=1)).astype(np.int32),
            "entries": entries,
            "starts": starts,
        }
        for name, values in constants.items():
            self.register_buffer(name, torch.from_numpy(values), persistent=False)

    def dense(self, weights: Tensor, rows: Tensor | None = None) -> Tensor:
        """Return weights (V, I), of all vertices or of those in `rows`, as a matrix (V, used joints)."""
        columns = self.columns if rows is None else self.columns[rows]
        return weights.new_zeros(len(weights), len(self.used)).scatter_add(1, columns, weights)

    def forward(self, rest: Tensor, offsets: Tensor | None, weights: Tensor, matrices: Tensor) -> Tensor:
        """Return skinned points (V, 3, N), differentiable in all but the rest shape.

        Args:
            rest: points (V, 3); offsets: added to them (V, 3, N), or None.
            weights: of the influences (V, I), zero where there is none; matrices: of all joints (J, 3, 4, N).
        """
        if kernels.available(rest.device):
            from .kernels.skinning import skin_kernel

            movers = (self.first_trainable, self.entries, self.starts)
            return skin_kernel(rest, offsets, weights, matrices, (self.joints, self.counts), movers)
        if loops.supports(matrices):
            from .loops.skinning import skin_loop

            trained = self.first_trainable, self.first_trainable + len(self.starts)
            return skin_loop(rest, offsets, weights, matrices, (self.joints, self.counts), trained)
        points = rest[:, :, None] if offsets is None else rest[:, :, None] + offsets
        return transform_points(blend_matrices(self.dense(weights), matrices[self.used]), points)

    def surface(self, points: Tensor, normals: Tensor, matrices: Tensor) -> tuple[Tensor, Tensor]:
        """Return skinned points and unit normals (V, 3, N) of points and normals (V, 3); without gradients."""
        if kernels.available(points.device):
            from .kernels.skinning import skin_surface_kernel

            return skin_surface_kernel(points, normals, self.weights, matrices, (self.joints, self.counts))
        if loops.supports(matrices):
            from .loops.skinning import skin_surface_loop

            return skin_surface_loop(points, normals, self.weights, matrices, (self.joints, self.counts))
        affine = blend_matrices(self.dense(self.weights), matrices[self.used])
        direction = transform_directions(affine, normals[:, :, None])
        return transform_points(affine, points[:, :, None]), direction / direction.norm(
            dim=1, keepdim=True
        ).clamp_min(1e-8)


def by_joint(indices: Ints, support: np.ndarray, trainable: range) -> tuple[Ints, Ints]:
    """Sort influences by joint and split those of each joint evenly.

    Args:
        indices: joints (V, I); support: which of them count (V, I); trainable: T consecutive joints.

    Returns:
        Flat indices of these joints' influences (E,), and the boundaries of their parts (T, PARTS + 1); int32.
    """
    chosen = np.flatnonzero(support & np.isin(indices, trainable))
    joint = indices.reshape(-1)[chosen]
    order = np.argsort(joint, kind="stable")
    first, stop = (np.searchsorted(joint[order], np.array(trainable) + side) for side in (0, 1))
    starts = first[:, None] + (stop - first)[:, None] * np.arange(PARTS + 1) // PARTS
    return chosen[order].astype(np.int32), starts.astype(np.int32)
