# SPDX-License-Identifier: Apache-2.0
"""The distance of decoded states to a Newton step, as a loss beside the energy.

Stretch and contact are thousands of times stiffer than inertia and gravity. A decoder of few shapes therefore gives
up where cloth hangs and how it moves to save a little of the stiff energies. With the Hessian H of the energy E and
the masses M, this loss is

    E + w/2 |x - x_N|^2_(M/dt^2),   x_N = x - H^-1 grad E

where x_N has no gradient. Its gradient, grad E + w M/dt^2 H^-1 grad E, counts millimetres of all modes alike, and it
vanishes where that of E does.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ..physics.energy import GarmentEnergy
from ..physics.simulate.hessian import Hessian
from ..physics.simulate.membrane import outer
from ..scene.assets import Scene

Planes = tuple[Tensor, Tensor]
EVERY = 4  # of so many frames one is solved; its part of the gradient counts for all of them
CG_ITERATIONS = 16
REDUCTION = 0.03  # of the residual, after which a frame iterates no more
STATIC_DT = 0.1  # [s]; single poses have no inertia, and this bounds their step, as in the simulator


class NewtonDistance:
    """Adds the gradient of the distance to the gradient of the energy.

    Args:
        dt: time step [s].
        weight: w, of the distance relative to the energy.

    Attributes:
        planes: the planes that the samples of the last positions can touch, as `Contacts.planes` returns them.
    """

    planes: Planes

    def __init__(self, scene: Scene, energy: GarmentEnergy, dt: float, weight: float) -> None:
        fabric = energy.fabric
        self.energy, self.weight = energy, weight
        self.inertia = energy.mass[:, None] / dt**2
        still, moving = torch.zeros_like(self.inertia), fabric.drag / fabric.density * energy.mass[:, None] / dt
        still[energy.tethered, 0] = energy.tether_stiffness
        self.diagonal = still + self.inertia + moving, still + energy.mass[:, None] / STATIC_DT**2
        self._hessian = Hessian.of(scene, energy)
        self.free = self._hessian.free

    def attach(self, x: Tensor, moving: int) -> Tensor:
        """Return positions x (V, 3, N), whose gradient gets the distance's added.

        Args:
            moving: how many of the frames have inertia; these come first.
        """
        return _Attached.apply(x, self, moving)

    def gradient(self, x: Tensor, gradient: Tensor, moving: int) -> Tensor:
        """Return the gradient of the loss (V, 3, N) from that of the energy, both [N]."""
        frames = torch.arange(0, x.shape[-1], EVERY, device=x.device)
        step = self.step(
            x[..., frames], gradient[..., frames], frames < moving, [v[..., frames] for v in self.planes]
        )
        return gradient.index_add(2, frames, -EVERY * self.weight * self.inertia[:, None] * step)

    def step(self, x: Tensor, gradient: Tensor, moving: Tensor, planes: list[Tensor]) -> Tensor:
        """Return the Newton step of each frame [m], (V, 3, N), zero for vertices that are not free.

        Args:
            moving: which frames have inertia, shape (N,).
            planes: normals (S, 3, N) and offsets (S, N) of the planes that the samples can touch.
        """
        normal, offset = planes
        distance = (normal * self.energy.cloth.positions(x)).sum(1) - offset
        stiffness = self.energy.cloth.area * self.energy.law.curvature(distance)
        diagonal = torch.where(moving, *self.diagonal)[self.free]
        matrix = self._hessian(x, diagonal, stiffness[:, None, None] * outer(normal, normal))
        # Checks would wait for the device, which a captured graph must not do.
        z, _ = matrix.solve(-gradient[self.free], REDUCTION, CG_ITERATIONS, check_every=CG_ITERATIONS + 1)
        return torch.zeros_like(x).index_copy(0, self.free, z)


class _Attached(torch.autograd.Function):
    @staticmethod
    def forward(ctx: torch.autograd.function.FunctionCtx, x: Tensor, distance: NewtonDistance, moving: int) -> Tensor:
        ctx.save_for_backward(x)
        ctx.distance, ctx.moving = distance, moving  # type: ignore[attr-defined]
        return x.view_as(x)

    @staticmethod
    def backward(ctx: torch.autograd.function.FunctionCtx, gradient: Tensor) -> tuple[Tensor, None, None]:
        (x,) = ctx.saved_tensors  # type: ignore[attr-defined]
        with torch.no_grad():
            return ctx.distance.gradient(x, gradient.contiguous(), ctx.moving), None, None  # type: ignore[attr-defined]
