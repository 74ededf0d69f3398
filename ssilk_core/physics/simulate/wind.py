# SPDX-License-Identifier: Apache-2.0
"""What moving air does to cloth, whose drag by mass is (c / rho) (w - v): linear in the air's velocity w.

c is `Fabric.drag` [kg/(m2 s)], rho its density [kg/m2], v the cloth's velocity. The potential has it as a pull
towards where the air carries the last positions.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from ...scene.fabrics import Fabric
from ..world.surroundings import PosedWorld
from .history import StepHistory


def carried_by_air(world: PosedWorld, past: StepHistory, root: Tensor, dt: float) -> Tensor:
    """Return the last positions [m], moved with the air for a time step, relative to the roots, shape (V, 3, N).

    Args:
        world: what surrounds the N characters at the end of the step.
        past: before it.
        dt: its length [s].
        root: positions of the roots at the end of the step [m], shape (3, N).
    """
    carried = past.local.clone()
    for frame, (air, seconds) in enumerate(zip(world.air, world.seconds, strict=True)):
        if air is not None:
            moved = past.last[..., frame]
            blown = torch.as_tensor(air.velocity(moved.cpu().numpy(), seconds).copy()).to(moved)
            carried[..., frame] = (moved + dt * blown - root[:, frame]).to(carried.dtype)
    return carried


def pushed_by_wind(garments: Sequence[tuple[slice, Fabric]], world: PosedWorld, lbs: Tensor) -> Tensor:
    """Return the mean acceleration by which wind pushes resting cloth [m/s2], shape (3, N).

    For several garments it is that of each at its vertices, shape (V, 3, N).

    Args:
        garments: the vertices of each, and its fabric.
        world: what surrounds the N characters.
        lbs: linear blend skinning, relative to the roots [m], shape (V, 3, N).
    """
    parts = [_pushed(world, lbs[rows], fabric) for rows, fabric in garments]
    if len(parts) == 1:
        return parts[0]
    return torch.cat([part.expand(rows.stop - rows.start, -1, -1) for part, (rows, _) in zip(parts, garments)])


def _pushed(world: PosedWorld, lbs: Tensor, fabric: Fabric) -> Tensor:
    """Return that of one garment, shape (3, N)."""
    pushed = torch.zeros_like(world.gravity)
    points = lbs.double().cpu().numpy()
    for frame, (air, seconds) in enumerate(zip(world.air, world.seconds, strict=True)):
        if air is not None:
            blown = air.velocity(points[..., frame] + world.roots[frame], seconds).mean(axis=0)
            pushed[:, frame] = torch.as_tensor(blown).to(pushed)
    return fabric.drag / fabric.density * pushed
