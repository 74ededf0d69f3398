# SPDX-License-Identifier: Apache-2.0
"""Energy, gradient and Gauss-Newton Hessian of bending.

The Gauss-Newton Hessian omits the second derivative of the angle: 2 k grad(theta) grad(theta)' is positive
semi-definite.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ...scene.assets import Ints
from ..energy.bending import bending_energy, cross, dihedral_angles, wrapped_difference
from ..operators import difference_operator

TINY = 1e-18


class Hinges:
    """The bending energy of hinges (H, 4) from `mesh.topology.hinges`.

    Args:
        stiffness, rest: factor of the squared angle [J] and angle at rest of each, as in `GarmentEnergy`, (H, 1).
    """

    def __init__(self, hinges: Ints, stiffness: Tensor, rest: Tensor, vertex_count: int) -> None:
        self.corners, self.stiffness, self.rest = hinges, stiffness, rest
        heads, tails = hinges[:, [1, 2, 3]].T.reshape(-1), hinges[:, [0, 0, 0]].T.reshape(-1)
        self.operator = difference_operator(heads, tails, vertex_count, self.rest.device, self.rest.dtype)

    def energy(self, x: Tensor) -> Tensor:
        """Return the energy [J], shape (N,)."""
        return bending_energy(dihedral_angles(*self.operator(x).chunk(3)), self.rest, self.stiffness).sum(0)

    def gradient(self, x: Tensor) -> Tensor:
        """Return the gradient [N], shape (V, 3, N)."""
        return self.operator.adjoint(torch.cat(self._pull(x)))

    def corner_forces(self, x: Tensor) -> Tensor:
        """Return the gradient of each hinge's energy at its `corners` [N], shape (H, 4, 3, N)."""
        edge, left, right = self._pull(x)
        return torch.stack([-(edge + left + right), edge, left, right], dim=1)

    def _pull(self, x: Tensor) -> list[Tensor]:
        """Return the gradient [N] at the edge's end and at the tips, each (H, 3, N)."""
        arms = self.operator(x).chunk(3)
        moment = 2 * self.stiffness * wrapped_difference(dihedral_angles(*arms), self.rest)
        return [moment[:, None] * slope for slope in angle_gradients(*arms)]

    def slopes(self, x: Tensor) -> Tensor:
        """Return sqrt(2 k) grad(theta) at the four vertices of each hinge, float32, shape (4 H, 3, N)."""
        edge, left, right = angle_gradients(*self.operator(x).float().chunk(3))
        root = (2 * self.stiffness.float()).sqrt()[:, None]
        return torch.cat([-root * (edge + left + right), root * edge, root * left, root * right])


def angle_gradients(edge: Tensor, left: Tensor, right: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the gradients of the dihedral angle at the edge's end and at the two tips, each (H, 3, N).

    Arguments are those of `dihedral_angles`. The gradient at a tip is perpendicular to its face, over its height. The
    reaction at the edge's ends divides in the ratio in which the foot of the height divides the edge.
    """
    normal_left, normal_right = cross(edge, left), cross(right, edge)
    squared = (edge * edge).sum(1, keepdim=True).clamp_min(TINY)
    length = squared.sqrt()
    square_left, square_right = ((normal**2).sum(1, keepdim=True) for normal in (normal_left, normal_right))
    # A hinge with a degenerate face has no gradient, as in `dihedral_angles`.
    stands = square_left * square_right >= (1e-6 * squared**2).clamp_min(TINY) ** 2
    tip_left = -length * normal_left / torch.where(stands, square_left, torch.inf)
    tip_right = -length * normal_right / torch.where(stands, square_right, torch.inf)
    foot_left, foot_right = ((edge * tip).sum(1, keepdim=True) / squared for tip in (left, right))
    return -(foot_left * tip_left + foot_right * tip_right), tip_left, tip_right
