# SPDX-License-Identifier: Apache-2.0
"""All energies of one garment, with its rest shape prepared once."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ..assets import Mesh
from ..fabrics import Fabric
from ..mesh import topology
from .bending import bending_energy, dihedral_angles
from .collision import PosedBody, collision_energy, signed_distance
from .operators import difference_operator
from .stretch import deformation_gradient_operator, rest_frames, stretch_density

TERMS = ("stretch", "bending", "gravity", "inertia", "collision")
"""The paper's terms; drag is trained with, but not counted, so that totals compare with its."""


class GarmentEnergy:
    """Energies of a garment mesh made of one fabric.

    Attributes:
        mass: lumped vertex masses [kg], shape (V,).
    """

    def __init__(
        self, mesh: Mesh, fabric: Fabric, *, device: torch.device | str = "cpu", dtype: torch.dtype = torch.float32
    ) -> None:
        device = torch.device(device)

        def tensor(values: np.ndarray) -> Tensor:
            return torch.tensor(values, dtype=dtype, device=device)

        _, areas = rest_frames(mesh)
        hinges = topology.hinges(mesh.faces)
        lengths = np.linalg.norm(mesh.points[hinges[:, 1]] - mesh.points[hinges[:, 0]], axis=1)
        both_areas = _hinge_areas(mesh, hinges)
        self.fabric = fabric
        self.area = tensor(areas)[:, None]
        self.mass = tensor(fabric.density * topology.vertex_areas(mesh.points, mesh.faces))
        self._gradient = deformation_gradient_operator(mesh, device, dtype)
        heads = hinges[:, [1, 2, 3]].T.reshape(-1)
        self._hinge = difference_operator(heads, np.tile(hinges[:, 0], 3), mesh.vertex_count, device, dtype)
        self.bending_stiffness = tensor(fabric.bending * lengths**2 / (8 * both_areas))[:, None]
        rest = tensor(mesh.points)[:, :, None]
        self.rest_angle = dihedral_angles(*self._hinge(rest).chunk(3)) if len(hinges) else rest.new_zeros(0, 1)

    def stretch(self, x: Tensor) -> Tensor:
        return (self.area * stretch_density(self._gradient(x), self.fabric)).sum(0)

    def bending(self, x: Tensor) -> Tensor:
        if self.rest_angle.shape[0] == 0 or self.fabric.bending == 0:
            return x.new_zeros(x.shape[-1])
        angle = dihedral_angles(*self._hinge(x).chunk(3))
        return bending_energy(angle, self.rest_angle, self.bending_stiffness).sum(0)

    def gravity(self, x: Tensor, gravity: Tensor) -> Tensor:
        """Return -sum m g.x [J]; `gravity` is the acceleration [m/s2] of each frame, shape (3, N) or (3, 1)."""
        return -(self.mass @ (x * gravity).sum(1))

    def inertia(self, x: Tensor, predicted: Tensor, dt: float) -> Tensor:
        """Return sum m/(2 dt^2) |x - predicted|^2; predicted = 2 x_{t-1} - x_{t-2} carries no gradient."""
        return self.mass @ ((x - predicted.detach()) ** 2).sum(1) / (2 * dt * dt)

    def drag(self, x: Tensor, carried: Tensor, dt: float) -> Tensor:
        """Return sum c a/(2 dt) |x - carried|^2, whose force is -c a v with v = (x - carried) / dt.

        `carried` is where the air took the last positions (V, 3, N); it carries no gradient.
        """
        weight = self.fabric.drag / self.fabric.density * self.mass
        return weight @ ((x - carried.detach()) ** 2).sum(1) / (2 * dt)

    def collision(self, x: Tensor, body: PosedBody) -> Tensor:
        return self.collision_of(signed_distance(x, body))

    def collision_of(self, distance: Tensor) -> Tensor:
        """Return the penalty of given signed distances (V, N)."""
        return collision_energy(distance, self.fabric.collision, self.fabric.margin).sum(0)


def _hinge_areas(mesh: Mesh, hinges: np.ndarray) -> np.ndarray:
    """Return the summed areas of the two faces at each hinge [m2], shape (H,)."""
    x0, x1, left, right = (mesh.points[hinges[:, i]] for i in range(4))
    return sum(np.linalg.norm(np.cross(x1 - x0, tip - x0), axis=1) / 2 for tip in (left, right))
