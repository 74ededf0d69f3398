# SPDX-License-Identifier: Apache-2.0
"""How far a method is from the solver that starts from the method's own states."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from torch import Tensor

from ...events import Countdown, Reporter, silent
from ...physics.simulate import Simulator
from ...physics.simulate.characters import PosedCharacters
from ...physics.simulate.simulator import StepHistory
from ...scene.assets import Motion
from .figures import SolverErrors
from .methods import EvaluationScene, LinearBlendSkinning, Method, TakeSet
from .metrics import mean_square

AFTER = (5, 10, 30, 60)  # frames after which the distance is measured
LENGTH = 2 + AFTER[-1]  # frames of a window: two states that are given, and those simulated
STEP_EVERY = 4  # frames between single steps
BATCH = 64  # windows simulated, or steps solved, in parallel

Window = tuple[int, range]
"""A take, and frames of it."""


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
) -> SolverErrors | None:
    """Measure single steps from the method's own past, and simulations from its own first two states.

    Windows in which the method is not finite are left out and counted; None where none is left.

    Args:
        windows: at least one, by decreasing length.
    """
    simulator = dressed.simulator
    played = [_World(dressed, take_set, method, window) for window in windows]
    played = [world for world in played if bool(world.x.isfinite().all())]
    if not played:
        return None
    singles = [(world, frame) for world in played for frame in range(2, len(world.x), STEP_EVERY)]
    told = Countdown(sum(len(world.x) - 2 for world in played) + len(singles), report)
    steps, shots = [], []
    for start in range(0, len(played), BATCH):
        shots.append(_shots(simulator, played[start : start + BATCH], dressed.energy.mass, told))
    for start in range(0, len(singles), BATCH):
        steps.append(_single_steps(simulator, singles[start : start + BATCH], dressed.energy.mass))
        told(len(steps[-1][0]))
    energy, square = (torch.cat(values) for values in zip(*steps))
    distance, velocity, lbs = (torch.cat([found[part] for found in shots], dim=1) for part in range(3))
    return SolverErrors(
        windows=len(played),
        lost=len(windows) - len(played),
        steps=len(singles),
        step_energy=float(energy.mean()),
        step_distance=float(square.mean().sqrt()),
        position_error=tuple(float(distance[after - 1].nanmean().sqrt()) for after in AFTER),
        median_position_error=tuple(float(distance[after - 1].nanmedian().sqrt()) for after in AFTER),
        velocity_error=float(velocity.nanmean().sqrt()) * dressed.fps,
        lbs_velocity_error=float(lbs.nanmean().sqrt()) * dressed.fps,
    )


class _World:
    """A method in a window: its motion, and positions (L, V, 3) in the world [m], float64."""

    def __init__(self, dressed: EvaluationScene, take_set: TakeSet, method: Method, window: Window) -> None:
        take, frames = window
        motion: Motion = take_set.takes[take].motion
        self.motion = motion.clip(frames.start, frames.stop)
        origin = torch.as_tensor(np.array(motion.translations[0, 0]), device=dressed.device)
        self.x = method.vertices(take, frames).double().permute(2, 0, 1) + origin


def _poses(simulator: Simulator, places: Sequence[tuple[_World, int]]) -> PosedCharacters:
    rotations, translations = (
        np.stack([getattr(world.motion, name)[frame] for world, frame in places])
        for name in ("rotations", "translations")
    )
    return simulator.poser.pose(rotations, translations)


def _stacked(places: Sequence[tuple[_World, int]], back: int) -> Tensor:
    """Return the positions (V, 3, N) so many frames before each place."""
    return torch.stack([world.x[frame - back] for world, frame in places], dim=-1)


def _history(simulator: Simulator, places: Sequence[tuple[_World, int]]) -> StepHistory:
    """Return the method's own two states before each place."""
    poses = _poses(simulator, [(world, frame - 1) for world, frame in places])
    return StepHistory(_stacked(places, 1), _stacked(places, 2), poses.root, poses.lbs)


def _single_steps(simulator: Simulator, places: Sequence[tuple[_World, int]], mass: Tensor) -> tuple[Tensor, Tensor]:
    """Return energies above the minimum [J] and squared distances from it [m2], each (N,)."""
    poses, past = _poses(simulator, places), _history(simulator, places)
    own = simulator.apply_pins(_stacked(places, 0) - poses.root, poses)
    inputs, potential = simulator.inputs(poses, past), simulator.potential
    found = simulator.solve(own, inputs)
    energy = potential.energy(own, inputs, potential.body_distance(own, inputs))
    return (energy - found.energy).cpu(), mean_square((own - found.x).double(), mass.double()).cpu()


def _shots(simulator: Simulator, windows: Sequence[_World], mass: Tensor, told: Countdown) -> Tensor:
    """Simulate from the first two states of windows, by decreasing length; count each frame of a window.

    Returns:
        Squared distances [m2], and squared differences of the displacements in a frame, of the method and of linear
        blend skinning [m2], (3, 60, N), NaN after the end of a window.
    """
    past = _history(simulator, [(world, 2) for world in windows])
    found = torch.full((3, AFTER[-1], len(windows)), torch.nan, dtype=torch.float64)
    steps = [[(world, at) for world in windows if len(world.x) > at] for at in range(2, len(windows[0].x))]
    states = simulator.carry_on(past, (_poses(simulator, places) for places in steps))
    for step, (places, state) in enumerate(zip(steps, states)):
        past = past.first(len(places))
        away, moved = _stacked(places, 0) - state.last, state.last - past.last
        lbs = state.lbs + state.root - past.lbs - past.root
        missed = [away, _stacked(places, 0) - _stacked(places, 1) - moved, lbs - moved]
        found[:, step, : len(places)] = torch.stack([mean_square(each, mass.double()) for each in missed]).cpu()
        past = state
        told(len(places))
    return found
