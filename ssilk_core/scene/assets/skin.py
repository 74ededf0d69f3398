# SPDX-License-Identifier: Apache-2.0
"""Sparse skinning weights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...errors import fail
from .arrays import Floats, Ints, assign, frozen, need_finite


@dataclass(frozen=True, eq=False)
class SkinWeights:
    """Sparse skinning weights: `indices` (V, I) into the joints, `weights` (V, I), rows sum to one."""

    path: str
    indices: Ints
    weights: Floats

    def __post_init__(self) -> None:
        assign(self, indices=frozen(self.indices, np.int32), weights=frozen(self.weights, np.float64))
        if not (self.indices.ndim == 2 and self.indices.shape == self.weights.shape):
            fail(
                self.path,
                f"joint indices of shape {self.indices.shape} and weights of shape {self.weights.shape}",
                "both need the shape (vertices, influences)",
            )
        need_finite(self.weights, self.path, "weight rows")
        negative = int(np.count_nonzero(self.weights < 0))
        if negative != 0:
            fail(
                self.path,
                f"{negative} skinning weights are negative",
                "weights must lie in [0, 1]",
                "normalise the weights and export again",
            )
        sums = self.weights.sum(axis=1)
        empty = int(np.count_nonzero(sums <= 1e-8))
        if empty != 0:
            fail(
                self.path,
                f"{empty} vertices have no skinning weight",
                "each vertex needs at least one",
                "bind or paint these vertices, or leave the weights out so that they are transferred from the body",
            )
        assign(self, weights=frozen(self.weights / sums[:, None], np.float64))

    @property
    def vertex_count(self) -> int:
        return len(self.indices)

    def check_joints(self, joint_count: int) -> None:
        """Raise `SsilkError` if an index is outside the joints."""
        bad = int(np.count_nonzero((self.indices < 0) | (self.indices >= joint_count)))
        if bad != 0:
            fail(
                self.path,
                f"{bad} joint indices lie outside 0 to {joint_count - 1}",
                "an index names a joint of the skeleton",
                "bind the mesh again",
            )

    def dense(self, joint_count: int) -> Floats:
        """Return the weights as a dense float64 matrix, shape (vertices, joints)."""
        matrix = np.zeros((self.vertex_count, joint_count))
        np.add.at(matrix, (np.arange(self.vertex_count)[:, None], self.indices), self.weights)
        return matrix

    @property
    def only_joint(self) -> int | None:
        """The joint that carries all vertices alone, as a bone carries what is parented to it; None without one."""
        used = np.unique(self.indices[self.weights > 0])
        return int(used[0]) if len(used) == 1 else None

    @classmethod
    def rigid(cls, path: str, joint: int, vertex_count: int) -> SkinWeights:
        """Return weights with which one joint carries all vertices."""
        return cls(path, np.full((vertex_count, 1), joint), np.ones((vertex_count, 1)))

    @classmethod
    def from_dense(cls, path: str, matrix: Floats, influences: int | None = None) -> SkinWeights:
        """Keep the `influences` largest weights of each row of `matrix` (V, J); all of them by default."""
        used = int((matrix > 0).sum(axis=1).max())
        count = max(1, min(influences or used, used))
        order = np.argsort(-matrix, axis=1, kind="stable")[:, :count]
        kept = np.take_along_axis(matrix, order, axis=1)
        return cls(path, np.where(kept > 0, order, 0), kept)
