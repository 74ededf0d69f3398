# SPDX-License-Identifier: Apache-2.0
"""Windows of a method, and the reference simulator that goes on from the method's own first two states in them.

A simulation of the whole clip differs from a method by all that the method ever did wrong. One from the method's own
states tells what it does wrong from there on. Any method of `methods` can be measured.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ...physics.simulate import Simulator
from ...physics.simulate.characters import PosedCharacters
from ...physics.simulate.simulator import StepHistory
from ...scene.assets import Motion
from ...scene.kinematics import first_place
from .kept_parts import NOTHING_KEPT, KeptParts
from .methods import EvaluationScene, Method, TakeSet
from .metrics import mean_square

BATCH = 64  # windows simulated in parallel

Window = tuple[int, range]
"""A take, and frames of it."""


class MethodWindow:
    """A method in a window.

    Attributes:
        motion: the character's.
        x: positions in the world [m], float64, shape (L, V, 3).
    """

    def __init__(self, dressed: EvaluationScene, take_set: TakeSet, method: Method, window: Window) -> None:
        take, frames = window
        motion: Motion = take_set.takes[take].motion
        self.motion = motion.clip(frames.start, frames.stop)
        origin = torch.as_tensor(first_place(motion, dressed.scene.character.skeleton), device=dressed.device)
        self.x = method.vertices(take, frames).double().permute(2, 0, 1) + origin

    def moved(self, offset: Tensor) -> MethodWindow:
        """Return the window with its vertices moved in all frames by (V, 3) [m]."""
        found = copy.copy(self)
        found.x = self.x + offset
        return found

    @property
    def is_finite(self) -> bool:
        return bool(self.x.isfinite().all())


Place = tuple[MethodWindow, int]
"""A window, and a frame of it."""


@dataclass(frozen=True, eq=False)
class Departures:
    """How a method departs from simulations from its own first two states, in F frames after these of N windows.

    All are means over mass, NaN after the end of a window.

    Attributes:
        position: squared distances [m2], shape (F, N).
        velocity: squared differences of the displacements in a frame [m2], shape (F, N).
        lbs_velocity: the same of linear blend skinning.
    """

    position: Tensor
    velocity: Tensor
    lbs_velocity: Tensor

    def position_after(self, frames: int) -> Tensor:
        """Return the squared distances so many frames after the second state [m2], shape (N,)."""
        if frames > len(self.position):
            return torch.full_like(self.position[0], torch.nan)
        return self.position[frames - 1]


@dataclass(frozen=True, eq=False)
class _Begun:
    """Windows after some steps of a simulation: figures as `_departures` has them, and the state, None at the end."""

    steps: int
    figures: Tensor
    state: StepHistory | None


@torch.no_grad()
def departures(
    simulator: Simulator,
    windows: Sequence[MethodWindow],
    mass: Tensor,
    advanced: Callable[[int], object],
    kept: KeptParts = NOTHING_KEPT,
) -> Departures:
    """Simulate from the first two states of windows.

    Args:
        windows: of three frames or more, by decreasing length; the method is finite in all.
        mass: of the vertices [kg], shape (V,).
        advanced: called with the number of frames that were simulated since the last call.
        kept: where simulations go on from, as far as they were simulated before.
    """
    frames = len(windows[0].x) - 2
    parts = [
        _departures(simulator, windows[start : start + BATCH], mass.double(), advanced, frames, kept.of(start))
        for start in range(0, len(windows), BATCH)
    ]
    return Departures(*torch.cat(parts, dim=-1))


def _departures(
    simulator: Simulator,
    windows: Sequence[MethodWindow],
    mass: Tensor,
    advanced: Callable[[int], object],
    frames: int,
    kept: KeptParts,
) -> Tensor:
    """Return the figures of `Departures` of one batch, shape (3, frames, N)."""
    found = torch.full((3, frames, len(windows)), torch.nan, dtype=torch.float64)
    begun = kept.get("windows", _Begun, windows[0].x.device)
    if begun:
        found[:, : begun.steps] = begun.figures[:, : begun.steps].cpu()
        advanced(sum(min(len(window.x) - 2, begun.steps) for window in windows))
    last = len(windows[0].x) - 2
    for step, (places, past, state) in enumerate(_steps(simulator, windows, begun), begun.steps if begun else 0):
        away, moved = stacked(places, 0) - state.last, state.last - past.last
        lbs = state.lbs + state.root - past.lbs - past.root
        missed = [away, stacked(places, 0) - stacked(places, 1) - moved, lbs - moved]
        found[:, step, : len(places)] = torch.stack([mean_square(each, mass) for each in missed]).cpu()
        advanced(len(places))
        if kept.due and step + 1 < last:
            kept.put("windows", _Begun(step + 1, found, state))
    if not begun or begun.state:
        kept.put("windows", _Begun(last, found, None))
    return found


def _steps(
    simulator: Simulator, windows: Sequence[MethodWindow], begun: _Begun | None = None
) -> Iterator[tuple[list[Place], StepHistory, StepHistory]]:
    """Yield the places that are stepped to, and the simulator's states before and after each step.

    Args:
        begun: whose steps are not taken again.
    """
    first = 2 + (begun.steps if begun else 0)
    steps = [[(window, at) for window in windows if len(window.x) > at] for at in range(first, len(windows[0].x))]
    if not steps:
        return
    past = begun.state if begun and begun.state else history(simulator, [(window, 2) for window in windows])
    states = simulator.carry_on(past, (poses_of(simulator, places) for places in steps))
    for places, state in zip(steps, states):
        yield places, past.first(len(places)), state
        past = state


@torch.no_grad()
def continuations(
    simulator: Simulator, windows: Sequence[MethodWindow], advanced: Callable[[int], object]
) -> list[Tensor]:
    """Return the simulator's positions in windows, from the first two states of each on.

    Args:
        windows, advanced: as for `departures`.

    Returns:
        Of each window, positions in the world [m], float64, shape (L, V, 3); the first two are the window's own.
    """
    found = [[*window.x[:2]] for window in windows]
    for start in range(0, len(windows), BATCH):
        for places, _, state in _steps(simulator, windows[start : start + BATCH]):
            for own, x in zip(found[start:], state.last.unbind(-1)):
                own.append(x)
            advanced(len(places))
    return [torch.stack(own) for own in found]


def poses_of(simulator: Simulator, places: Sequence[Place]) -> PosedCharacters:
    """Return the characters of N places."""
    rotations, translations = (
        np.stack([getattr(window.motion, name)[frame] for window, frame in places])
        for name in ("rotations", "translations")
    )
    return simulator.poser.pose(rotations, translations)


def stacked(places: Sequence[Place], back: int) -> Tensor:
    """Return the positions (V, 3, N) so many frames before each place."""
    return torch.stack([window.x[frame - back] for window, frame in places], dim=-1)


def history(simulator: Simulator, places: Sequence[Place]) -> StepHistory:
    """Return the method's own two states before each place."""
    poses = poses_of(simulator, [(window, frame - 1) for window, frame in places])
    at = poses.root, poses.lbs
    return StepHistory(stacked(places, 1), stacked(places, 2), *at, matrices=poses.matrices)
