# SPDX-License-Identifier: Apache-2.0
"""Energy of single vertices and samples; reference: the sums in `simulate.incremental_potential`.

A loop owns some frames, and adds up their energies in float64.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from .compiling import compiled
from .running import array, run_parts


def points_loop(
    x: Tensor,
    mass: Tensor,
    gravity: Tensor,
    anchors: Sequence[tuple[Tensor, Tensor]],
    samples: Tensor,
    planes: tuple[Tensor, Tensor] | None,
    area: Tensor,
    law: tuple[float, float, float],
    wanted: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the energy of gravity, anchors and contact [J] (N,) and, where wanted, its gradient at vertices without
    contact (V, 3, N) and that of contact at samples (S, 3, N) [N].

    Args:
        x: positions (V, 3, N); mass: (V, 1); gravity: (3, N) or (3, 1).
        anchors: stiffness (V, 1) and target (V, 3, N), or one for all frames (V, 3, 1), of each spring to a point.
        samples: positions (S, 3, N); area: of each, (S, 1).
        planes: normals (S, 3, N) and offsets (S, N) of the distance to the body, or None without contact.
        law: stiffness, start and ramp of `energy.collision.ContactLaw`.
    """
    vertices, _, frames = x.shape
    normal, offset = (x[:0], x[:0, 0]) if planes is None else planes
    touching = len(normal)
    weights = torch.cat([weight for weight, _ in anchors], dim=1) if anchors else x.new_zeros(vertices, 0)
    targets = torch.stack([target.expand_as(x) for _, target in anchors]) if anchors else x.new_zeros(0, *x.shape)
    energy = x.new_empty(frames)
    slopes = x.new_empty(vertices if wanted else 0, 3, frames), x.new_empty(touching if wanted else 0, 3, frames)
    given = array(x), array(mass[:, 0]), array(gravity.expand(3, frames)), array(weights), array(targets)
    contact = array(samples), array(normal), array(offset), array(area[:, 0]), *law
    run_parts(_points, frames, *given, *contact, energy.numpy(), *(slope.numpy() for slope in slopes))
    return energy, *slopes


@compiled
def _points(x, mass, gravity, weights, targets, samples, normal, offset, area, stiffness, first, ramp, energy,
            slopes, pushes, start, stop):  # fmt: skip
    for n in range(start, stop):
        total = 0.0
        for v in range(len(x)):
            for axis in range(3):
                at = np.float64(x[v, axis, n])
                slope = -np.float64(mass[v]) * gravity[axis, n]
                total += at * slope
                for anchor in range(len(targets)):
                    weight, away = np.float64(weights[v, anchor]), at - targets[anchor, v, axis, n]
                    total += 0.5 * weight * away * away
                    slope += weight * away
                if len(slopes):
                    slopes[v, axis, n] = slope
        for s in range(len(normal)):
            distance = -np.float64(offset[s, n])
            for axis in range(3):
                distance += np.float64(normal[s, axis, n]) * samples[s, axis, n]
            depth, pressure = first - distance, 0.0
            if not depth <= 0:  # what is not a number stays so
                if depth < ramp:
                    total += area[s] * stiffness * depth * depth * depth / (6 * ramp)
                    pressure = stiffness * depth * depth / (2 * ramp)
                else:
                    total += area[s] * stiffness * (0.5 * depth * (depth - ramp) + ramp * ramp / 6)
                    pressure = stiffness * (depth - 0.5 * ramp)
            if len(pushes):
                for axis in range(3):
                    pushes[s, axis, n] = -area[s] * pressure * normal[s, axis, n]
        energy[n] = total
