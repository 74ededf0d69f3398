# SPDX-License-Identifier: Apache-2.0
"""What a frame minimises: the training energy, with its gradient and Hessian.

Implicit Euler with time step dt is the minimum of

    stretch + bending + gravity + collision + m/(2 dt^2) |x - (2 x' - x'')|^2 + drag a/(2 dt) |x - carried|^2

(`energy.GarmentEnergy`); a quasi-static state leaves the last two out. The distance to the body is that to the whole
surface a vertex may meet, and not to the triangles around the nearest vertex alone, as in training; it is rounded on
its creases (`energy.rounded`), so that minima there have a gradient of zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ..assets import PINNED, Scene
from ..energy import GarmentEnergy
from ..energy.collision import PosedBody, collision_energy
from ..energy.rounded import Rounded
from ..fabrics import Fabric
from ..mesh import topology
from ..model.contacts import Contacts
from ..model.descriptors import GRAVITY
from .blocks import BlockMatrix
from .hessian import Hessian
from .hinges import Hinges
from .membrane import Membrane, outer


@dataclass(frozen=True, eq=False)
class Setting:
    """All that a frame's energy depends on but the garment; N frames.

    Attributes:
        body: in the coordinates of the positions, float32.
        gravity: acceleration [m/s2], shape (3, N).
        predicted: 2 x' - x'' [m], shape (V, 3, N), or None for a quasi-static state.
        carried: where the air took x' [m], shape (V, 3, N), or None likewise.
        dt: time step [s]. In a quasi-static state it damps the steps of the solver alone.
    """

    body: PosedBody | None
    gravity: Tensor
    predicted: Tensor | None = None
    carried: Tensor | None = None
    dt: float = 0.1

    def picked(self, frames: Tensor) -> Setting:
        """Return the setting of some of the frames, indices (M,)."""
        body = self.body and self.body.picked(frames)
        predicted, carried = (v if v is None else v[..., frames] for v in (self.predicted, self.carried))
        return Setting(body, self.gravity[..., frames], predicted, carried, self.dt)


class Potential:
    """The energy of one garment in any setting; positions are (V, 3, N).

    Attributes:
        free: indices of the vertices that move: all with mass that are not pinned, shape (U,).
        size: diagonal of the garment's box at rest [m].

    Args:
        dtype: of positions, energies and gradients; Hessians are float32.
    """

    def __init__(
        self, scene: Scene, fabric: Fabric, *, device: torch.device, dtype: torch.dtype = torch.float64
    ) -> None:
        mesh = scene.garment.mesh
        energy = GarmentEnergy(mesh, fabric, device=device, dtype=dtype)
        hinges = topology.hinges(mesh.faces) if fabric.bending else np.zeros((0, 4), dtype=np.int64)
        self.fabric, self.dtype = fabric, dtype
        self.mass: Tensor = energy.mass[:, None]
        self.size = float(np.linalg.norm(np.ptp(mesh.points, axis=0)))
        self.contacts = Contacts(scene, device=device)
        self.membrane = Membrane(mesh, fabric, device, dtype)
        self.hinges = Hinges(hinges, energy, mesh.vertex_count) if len(hinges) else None
        free = np.flatnonzero((scene.classes != PINNED) & (topology.vertex_areas(mesh.points, mesh.faces) > 0))
        self.free = torch.as_tensor(free, device=device)
        self._hessian = Hessian(self.membrane, self.hinges, hinges, free, mesh.vertex_count)

    def met(self, x: Tensor, setting: Setting) -> Rounded | None:
        """Return the distances of x to the body, to second order."""
        return None if setting.body is None else self.contacts.rounded(x, setting.body)

    def energy(self, x: Tensor, setting: Setting, met: Rounded | None) -> Tensor:
        """Return the energy [J] of each frame, shape (N,), with the distances that x has by `met`."""
        total = self.membrane.energy(x) - (self.mass * (x * setting.gravity).sum(1)).sum(0)
        if self.hinges:
            total = total + self.hinges.energy(x)
        for weight, target in self._anchors(setting):
            total = total + (0.5 * weight * ((x - target) ** 2).sum(1)).sum(0)
        return total + self.collision(x, met).sum(0)

    def collision(self, x: Tensor, met: Rounded | None) -> Tensor:
        """Return the energy of each vertex that meets the body [J], shape (V, N)."""
        return torch.zeros_like(x[:, 0]) if met is None else self.collision_at(met.distance(x))

    def collision_at(self, distance: Tensor) -> Tensor:
        """Return the energy of vertices so far from the body [J], shape (V, N)."""
        return collision_energy(distance, self.fabric.collision, self.fabric.margin)

    def gradient(self, x: Tensor, setting: Setting, met: Rounded | None) -> Tensor:
        """Return the gradient [N] in all vertices, shape (V, 3, N)."""
        total = self.membrane.gradient(x) - self.mass[:, None] * setting.gravity
        if self.hinges:
            total += self.hinges.gradient(x)
        for weight, target in self._anchors(setting):
            total += weight[:, None] * (x - target)
        if met:
            total -= self._push(x, met)[:, None] * met.normal
        return total

    def hessian(
        self,
        x: Tensor,
        setting: Setting,
        met: Rounded | None,
        held: Tensor | None = None,
        whole: Tensor | None = None,
    ) -> BlockMatrix:
        """Return the Hessian over the free vertices, in float32, its parts made positive semi-definite.

        Args:
            held: vertices that are made too stiff to move, shape (V, N); none by default.
            whole: frames whose membrane keeps what compression takes from its Hessian, which may make it indefinite,
                shape (N,); none by default.
        """
        still = [] if setting.predicted is not None else [(self.mass / setting.dt**2, None)]
        weight = sum((weight for weight, _ in [*self._anchors(setting), *still]), torch.zeros_like(self.mass))
        contact = None
        if met:
            push, normal = self._push(x, met)[self.free], met.normal[self.free]
            stiffness = 2 * self.fabric.collision * (push > 0)
            contact = (
                stiffness[:, None, None] * outer(normal, normal) + push[:, None, None] * met.curvature[self.free]
            )
        held = None if held is None else held[self.free]
        return self._hessian(x, weight[self.free].float(), contact, held, whole)

    def imbalance(self, gradient: Tensor) -> Tensor:
        """Return the RMS acceleration, over the free mass, that a gradient (V, 3, N) leaves, in units of g: (N,)."""
        force, mass = gradient[self.free], self.mass[self.free]
        return ((force * force).sum(1) / mass).sum(0).div(mass.sum()).sqrt() / GRAVITY

    def _anchors(self, setting: Setting) -> list[tuple[Tensor, Tensor]]:
        """Return stiffness [N/m] (V, 1) and target (V, 3, N) of inertia and drag, where they act."""
        found = []
        if setting.predicted is not None:
            found.append((self.mass / setting.dt**2, setting.predicted))
        if setting.carried is not None and self.fabric.drag:
            found.append((self.fabric.drag / self.fabric.density * self.mass / setting.dt, setting.carried))
        return found

    def _push(self, x: Tensor, met: Rounded) -> Tensor:
        """Return the force along the gradient of the distance on each vertex within the margin [N], shape (V, N)."""
        return 2 * self.fabric.collision * (self.fabric.margin - met.distance(x)).clamp_min(0)
