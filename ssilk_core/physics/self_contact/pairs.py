# SPDX-License-Identifier: Apache-2.0
"""What can touch: a vertex and a face, or two edges, as four vertices with coefficients.

Between the nearest points of a pair lies r = sum c_i x_i, with the coefficients (1, -w) of a vertex and the point w
of a face, or (1 - s, s, t - 1, -t) of points of two edges. Where these lie within the face and the edges, the pair
faces each other: r is parallel to the face's normal, or to the cross product of the edges, and the sign of its height
along that says on which side the pair is. This changes only where cloth passes through cloth, or where one of the
points comes to a border of its face or edge.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from ..collision.one_ring import closest_in_triangle

PARALLEL = 1e-4  # squared sine of the angle between edges below which they do not face each other
TINY = 1e-24


@dataclass(frozen=True, eq=False)
class Separations:
    """How P pairs are separated.

    Attributes:
        coefficients: c_i, shape (4, P).
        distance: |r| [m], shape (P,).
        direction: of r, unit vectors, shape (3, P).
        facing: whether the nearest points lie within face and edges, shape (P,).
        normal: of the face, or across both edges, unit vectors, shape (3, P).
        height: of one over the other along the normal [m], shape (P,); the distance up to its sign where they face.
    """

    coefficients: Tensor
    distance: Tensor
    direction: Tensor
    facing: Tensor
    normal: Tensor
    height: Tensor

    def kept(self, kept: Tensor | slice) -> Separations:
        """Return the separations of the pairs that `kept` names."""
        return Separations(*(getattr(self, each.name)[..., kept] for each in fields(self)))

    def gaps(self, side: Tensor) -> tuple[Tensor, Tensor]:
        """Return the distances [m], negative on the wrong side, and in which direction they grow, (P,), (3, P).

        Args:
            side: where each pair belongs, 0 for wherever it is, shape (P,).
        """
        sign = torch.where(side == 0, torch.where(self.height < 0, -1, 1), side)
        gap = torch.where(self.facing, sign * self.height, self.distance)
        direction = torch.where(self.facing, sign * self.normal, self.direction)
        return gap, direction


def over_faces(corners: Tensor) -> Separations:
    """Return the separations of vertices from faces (4, 3, P): the vertex, then the corners of its face."""
    p, a, b, c = corners
    first, second, arm = b - a, c - a, p - a
    s, t, _ = closest_in_triangle(arm, first, second)
    coefficients = torch.stack([torch.ones_like(s), s + t - 1, -s, -t])
    normal = _unit(torch.linalg.cross(first, second, dim=0))
    facing = (s > 0) & (t > 0) & (s + t < 1)
    return _separations(arm - s * first - t * second, coefficients, facing, normal, arm)


def between_edges(corners: Tensor) -> Separations:
    """Return the separations of pairs of edges (4, 3, P): the ends of one, then those of the other."""
    a, b, c, d = corners
    first, second, arm = b - a, d - c, a - c
    ff, ss, fs = ((u * v).sum(0) for u, v in ((first, first), (second, second), (first, second)))
    fa, sa = (first * arm).sum(0), (second * arm).sum(0)
    determinant = ff * ss - fs * fs
    s = ((fs * sa - ss * fa) / determinant.clamp_min(TINY)).clamp(0, 1)
    t = (fs * s + sa) / ss.clamp_min(TINY)
    s = torch.where((t < 0) | (t > 1), (fs * t.clamp(0, 1) - fa) / ff.clamp_min(TINY), s).clamp(0, 1)
    t = t.clamp(0, 1)
    coefficients = torch.stack([1 - s, s, t - 1, -t])
    normal = _unit(torch.linalg.cross(first, second, dim=0))
    facing = (determinant > PARALLEL * ff * ss) & (s > 0) & (s < 1) & (t > 0) & (t < 1)
    return _separations(arm + s * first - t * second, coefficients, facing, normal, arm)


def _separations(r: Tensor, coefficients: Tensor, facing: Tensor, normal: Tensor, arm: Tensor) -> Separations:
    distance = r.norm(dim=0)
    return Separations(coefficients, distance, _unit(r), facing, normal, (arm * normal).sum(0))


def _unit(vectors: Tensor) -> Tensor:
    return vectors / vectors.norm(dim=0).clamp_min(TINY)
