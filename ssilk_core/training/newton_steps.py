# SPDX-License-Identifier: Apache-2.0
"""Measures what single steps of a model miss: how far they are from the minimum of their own energy.

A step from the past x', x'' should minimise the incremental potential E (`simulate.incremental_potential`). With its
Hessian H, a Newton step from where the model goes,

    s = -H^-1 grad E(x),

is where the solver would move it, and -s.grad E / 2 is the energy that this would win, to second order. H is the
solver's, projected to be positive semi-definite, and like the solver's the step moves no vertex further than a tenth
of the garment's size. `ssilk evaluate --solver` goes on to the minimum itself, which takes far longer.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ..physics.collision import PosedBody
from ..physics.constants import GRAVITY
from ..physics.simulate.incremental_potential import IncrementalPotential, StepInputs
from ..physics.simulate.newton import State, newton_step
from ..scene.assets import Scene
from ..scene.fabrics import Fabric

REDUCTION, CG_ITERATIONS = 0.01, 300  # of the residual by the linear solve, and its longest
VERTICES_AT_ONCE = 160_000  # of all frames whose Hessians are in memory together


class NewtonSteps:
    """Measures steps of one garment.

    Args:
        fps: steps per second [1/s].
    """

    def __init__(self, scene: Scene, fabric: Fabric, fps: float, device: torch.device) -> None:
        self.potential = IncrementalPotential(scene, fabric, device=device, dtype=torch.float32)
        self.potential.in_graphs = False  # a training counts its memory before
        self.dt = 1 / fps

    @torch.no_grad()
    def measure(
        self, path: Sequence[Tensor], lbs: Tensor, body: PosedBody | None, shift: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the energy that a Newton step wins [J] and its squared length over mass [m2], each (N,).

        Args:
            path: positions x'', x' and x of each frame, (V, 3, N) [m].
            lbs: linear blend skinning at x, (V, 3, N) [m].
            body: at x.
            shift: how far the root moved from x' to x, (3, N) [m]; the air moves along.
        """
        if not len(self.potential.free):
            return torch.zeros_like(lbs[0, 0]), torch.zeros_like(lbs[0, 0])
        at_once = max(1, VERTICES_AT_ONCE // len(lbs))
        parts = [
            self._measure(
                [x[..., frames] for x in path], lbs[..., frames], body and body.select(frames), shift[:, frames]
            )
            for frames in torch.arange(lbs.shape[-1], device=lbs.device).split(at_once)
        ]
        energy, square = (torch.cat(values) for values in zip(*parts))
        return energy, square

    def _measure(
        self, path: list[Tensor], lbs: Tensor, body: PosedBody | None, shift: Tensor
    ) -> tuple[Tensor, Tensor]:
        potential, (before, last, x) = self.potential, path
        gravity = torch.zeros_like(shift)
        gravity[1] = -GRAVITY
        inputs = StepInputs(body, gravity, 2 * last - before, last + shift, self.dt, lbs)
        state = State.at(potential, lbs.index_copy(0, potential.free, x[potential.free]), inputs)
        gradient = potential.gradient(state.x, inputs, state.body_distance)
        step, _ = newton_step(potential, state, inputs, gradient, CG_ITERATIONS, reduction=REDUCTION)
        mass = potential.mass[:, 0]
        return -0.5 * (gradient * step).sum((0, 1)), mass @ (step * step).sum(1) / mass.sum()
