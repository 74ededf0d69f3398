# SPDX-License-Identifier: Apache-2.0
"""Minima of the static energy of cloth in held poses, found without any network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ...physics.simulate import Simulator
from ...physics.simulate.characters import PosedCharacters
from ...scene.kinematics import first_place
from .figures import MinimumErrors
from .metrics import mean_square
from .takes import Take


@dataclass(frozen=True, eq=False)
class Minima:
    """Minima of the static energy in N poses; positions (V, 3, N) [m] are about the roots.

    A garment has many minima, one for each set of folds. These are the ones that searches from `start` reach.

    Attributes:
        start: where the searches began.
        x: the minima.
        residual: of the solver [g], shape (N,).
    """

    simulator: Simulator
    poses: PosedCharacters
    start: Tensor
    x: Tensor
    residual: Tensor

    def energy_excess(self) -> Tensor:
        """Return the static energy of the starts above that of the minima [J], shape (N,)."""
        potential, inputs = self.simulator.potential, self.simulator.inputs(self.poses, None)
        start, lowest = (
            potential.energy(x, inputs, potential.body_distance(x, inputs)) for x in (self.start, self.x)
        )
        return start - lowest

    def gravity_excess(self, x: Tensor) -> Tensor:
        """Return the gravity energy of x (V, 3, N) above that of the minima [J], shape (N,)."""
        return (self.simulator.potential.mass * ((self.x - x) * self.simulator.gravity).sum(1)).sum(0)

    def inside(self, x: Tensor) -> Tensor:
        """Return the share of vertices inside any part of the body, shape (N,)."""
        body = self.simulator.inputs(self.poses, None).body
        assert body is not None
        _, nearest = self.simulator.potential.contacts.distances(
            self.simulator.potential.cloth.positions(x).float(), body
        )
        return (nearest[: len(x)] < 0).double().mean(0)

    def distance(self) -> Tensor:
        """Return the RMS distance over the mass of the starts from the minima [m], shape (N,)."""
        return mean_square(self.start - self.x, self.simulator.potential.mass[:, 0]).sqrt()


def minima(simulator: Simulator, takes: Sequence[Take], x: Tensor) -> Minima:
    """Minimise the static energy in the last pose of each take, from x (V, 3, N), about the roots of first frames."""
    motions = [take.motion for take in takes]
    rotations, translations = (
        np.stack([getattr(motion, name)[-1] for motion in motions]) for name in ("rotations", "translations")
    )
    poses = simulator.poser.pose(rotations, translations)
    skeleton = simulator.poser.skeleton
    origins = torch.as_tensor(np.stack([first_place(m, skeleton) for m in motions], axis=1), device=x.device)
    start = simulator.apply_pins(x.double() + origins - poses.root, poses)
    found = simulator.quasi_static(poses, start)
    return Minima(simulator, poses, start, found.x, found.residual)


def minimum_errors(found: Minima, weight: float) -> list[MinimumErrors]:
    """Return the figures of each pose, for a garment of m g L [J]."""
    garment, lbs = (found.gravity_excess(x) / weight for x in (found.start, found.poses.lbs))
    columns = (found.energy_excess(), garment, lbs, found.distance(), found.residual)
    names = ("static_energy_excess", "gravity_excess", "lbs_gravity_excess", "minimum_distance", "max_residual")
    return [MinimumErrors(stops=1, **dict(zip(names, row))) for row in torch.stack(columns, dim=1).tolist()]
