# SPDX-License-Identifier: Apache-2.0
"""The energy of contact with the body.

A fabric's own law acts on its surface. With the gap d between the cloth's inner face and the body, the margin m and
the depth delta = max(m - d, 0), the pressure on the cloth is

    p = K delta^2 / (2 m)   for delta <= m, and   p = K (delta - m / 2)   deeper,

so that its stiffness grows from zero at the margin to K [N/m3] at the skin, without a jump for a solver or a gradient
to meet. The paper's energy (Section 3.5) counts vertices: k delta^2 for each, whatever its area.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ...scene.fabrics import Fabric

TINY = 1e-12  # [m]


@dataclass(frozen=True)
class ContactLaw:
    """How contact depends on the distance of the cloth to the body, for each area, or each vertex in the paper's law.

    Attributes:
        stiffness: second derivative of the energy below `ramp` [N/m3] (paper: [N/m]).
        start: distance to the mesh at which contact begins [m].
        ramp: depth over which the stiffness grows from zero [m]; zero for the paper's law.
    """

    stiffness: float
    start: float
    ramp: float

    @classmethod
    def of(cls, fabric: Fabric) -> ContactLaw:
        """Return the law of a fabric where it is stiffest; its mesh lies in the middle of its thickness."""
        start = fabric.contact_distance
        if fabric.contact_model == "vertex":
            return cls(2 * fabric.collision, start, 0.0)
        return cls(max(fabric.contact, fabric.loose_contact), start, fabric.margin)

    def energy(self, distance: Tensor) -> Tensor:
        """Return the energy for each area [J/m2] (paper: [J]) at distances of the mesh [m], of the same shape."""
        depth = self._depth(distance)
        soft = depth**3 / (6 * max(self.ramp, TINY))
        deep = 0.5 * depth * (depth - self.ramp) + self.ramp**2 / 6
        return self.stiffness * torch.where(depth < self.ramp, soft, deep.where(depth != 0, 0))

    def pressure(self, distance: Tensor) -> Tensor:
        """Return minus the derivative of the energy [Pa] (paper: [N])."""
        depth = self._depth(distance)
        soft = depth**2 / (2 * max(self.ramp, TINY))
        return self.stiffness * torch.where(depth < self.ramp, soft, (depth - 0.5 * self.ramp).where(depth != 0, 0))

    def curvature(self, distance: Tensor) -> Tensor:
        """Return the second derivative of the energy [N/m3] (paper: [N/m])."""
        depth = self._depth(distance)
        return self.stiffness * torch.where(
            depth < self.ramp, depth / max(self.ramp, TINY), (depth / depth).where(depth != 0, 0)
        )

    def _depth(self, distance: Tensor) -> Tensor:
        return (self.start - distance).clamp_min(0)
