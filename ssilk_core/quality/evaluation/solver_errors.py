# SPDX-License-Identifier: Apache-2.0
"""How far a method is from the solver that starts from the method's own states."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ...events import Countdown, Reporter, silent
from ...physics.simulate import Simulator
from .figures import SolverErrors
from .kept_parts import NOTHING_KEPT, KeptParts
from .methods import EvaluationScene, LinearBlendSkinning, Method, TakeSet
from .metrics import mean_square
from .own_starts import MethodWindow, Place, Window, departures, history, poses_of, stacked

AFTER = (5, 10, 30, 60)  # frames after which the distance is measured
LENGTH = 2 + AFTER[-1]  # frames of a window: two states that are given, and those simulated
STEP_EVERY = 4  # frames between single steps
BATCH = 64  # steps solved in parallel


@dataclass(frozen=True, eq=False)
class _SingleSteps:
    """Energies above the minimum [J], and squared distances from it [m2], of N single steps, each (N,)."""

    energy: Tensor
    square: Tensor


def windows_of(dressed: EvaluationScene, take_set: TakeSet, takes: Iterable[int]) -> list[Window]:
    """Return the start of each take, and a window from the start of its most violent second on, longest first."""
    lbs, second, found = LinearBlendSkinning(dressed, take_set), round(dressed.fps), []
    for number in takes:
        count = take_set.takes[number].frame_count
        if count < 2 + AFTER[0]:
            continue
        speed = mean_square(lbs.vertices(number, range(count)).diff(dim=-1), dressed.energy.mass).double()
        total = torch.cat([speed.new_zeros(1), speed.cumsum(0)])
        summed = total[second:] - total[:-second] if len(total) > second else total[-1:]
        violent = min(int(summed.argmax()), max(0, count - LENGTH))
        found += [(number, range(start, min(start + LENGTH, count))) for start in dict.fromkeys([0, violent])]
    return sorted(found, key=lambda window: -len(window[1]))


@torch.no_grad()
def solver_errors(
    dressed: EvaluationScene,
    take_set: TakeSet,
    method: Method,
    windows: Sequence[Window],
    report: Reporter = silent,
    kept: KeptParts = NOTHING_KEPT,
) -> SolverErrors | None:
    """Measure single steps from the method's own past, and simulations from its own first two states.

    Windows in which the method is not finite are left out and counted; None where none is left.

    Args:
        windows: at least one, by decreasing length.
        kept: what of them was measured before.
    """
    simulator = dressed.simulator
    played = [MethodWindow(dressed, take_set, method, window) for window in windows]
    played = [window for window in played if window.is_finite]
    if not played:
        return None
    singles = [(window, frame) for window in played for frame in range(2, len(window.x), STEP_EVERY)]
    told = Countdown(sum(len(window.x) - 2 for window in played) + len(singles), report)
    away, steps = departures(simulator, played, dressed.energy.mass, told, kept), []
    for start in range(0, len(singles), BATCH):
        known = kept.get(f"single steps from {start}", _SingleSteps)
        steps.append(known or _single_steps(simulator, singles[start : start + BATCH], dressed.energy.mass))
        if not known:
            kept.put(f"single steps from {start}", steps[-1])
        told(len(steps[-1].energy))
    energy, square = (torch.cat([getattr(each, name) for each in steps]) for name in ("energy", "square"))
    return SolverErrors(
        windows=len(played),
        lost=len(windows) - len(played),
        steps=len(singles),
        step_energy=float(energy.mean()),
        step_distance=float(square.mean().sqrt()),
        position_error=tuple(float(away.position_after(after).nanmean().sqrt()) for after in AFTER),
        median_position_error=tuple(float(away.position_after(after).nanmedian().sqrt()) for after in AFTER),
        velocity_error=float(away.velocity.nanmean().sqrt()) * dressed.fps,
        lbs_velocity_error=float(away.lbs_velocity.nanmean().sqrt()) * dressed.fps,
    )


def _single_steps(simulator: Simulator, places: Sequence[Place], mass: Tensor) -> _SingleSteps:
    """Solve one step to each place, from the method's own two states before it."""
    poses, past = poses_of(simulator, places), history(simulator, places)
    own = simulator.apply_pins(stacked(places, 0) - poses.root, poses)
    inputs, potential = simulator.inputs(poses, past), simulator.potential
    found = simulator.solve(own, inputs)
    energy = potential.energy(own, inputs, potential.body_distance(own, inputs))
    away = mean_square((own - found.x).double(), mass.double())
    return _SingleSteps((energy - found.energy).cpu(), away.cpu())
