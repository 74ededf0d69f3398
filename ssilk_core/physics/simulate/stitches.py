# SPDX-License-Identifier: Apache-2.0
"""Gradient and Gauss-Newton Hessian of stitches.

With the offset r = x - sum w_i x_i - h n and its Jacobian J, the Hessian k J'J omits the second derivative of the
normal: it is positive semi-definite, and exact where the spring is at rest.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..energy.bending import cross
from ..energy.stitching import Stitching


def stitch_gradient(stitching: Stitching, x: Tensor) -> Tensor:
    """Return the gradient [N] at positions (V, 3, N), of the same shape."""
    arm, first, second = stitching.arms(x)
    normal, length = stitching.normal(first, second)
    force = stitching.stiffness[:, None] * (arm - stitching.height * normal)
    turning = -stitching.height / length * (force - normal * (normal * force).sum(1, keepdim=True))
    return stitching.to_vertices(force, cross(second, turning), cross(turning, first))


def stitch_slopes(stitching: Stitching, x: Tensor) -> Tensor:
    """Return sqrt(k) J at the four vertices of each stitch, float32, shape (4 S, 3, 3, N): offset, then vertex."""
    _, first, second = (arm.float() for arm in stitching.arms(x))
    normal, length = (part.float() for part in stitching.normal(first, second))
    turn = stitching.height.float() / length
    identity = torch.eye(3, device=x.device)[:, :, None]
    tangent = turn[:, None] * (identity - normal[:, :, None] * normal[:, None])
    by_first, by_second = _times_cross(tangent, second), -_times_cross(tangent, first)
    a, b, c = (weight * identity for weight in stitching.weights.float()[:, :, :, None, None].unbind(1))
    slopes = torch.cat([identity.expand_as(by_first), -a - by_first - by_second, by_first - b, by_second - c])
    return stitching.stiffness.float().sqrt()[:, None, None].repeat(4, 1, 1, 1) * slopes


def _times_cross(matrix: Tensor, vector: Tensor) -> Tensor:
    """Return matrices (S, 3, 3, N) times those that take the cross product with vectors (S, 3, N) from the left."""
    return torch.stack([cross(row, vector) for row in matrix.unbind(1)], dim=1)
