# SPDX-License-Identifier: Apache-2.0
"""Windows of a method, and the reference simulator that goes on from the method's own first two states in them.

A simulation of the whole clip differs from a method by all that the method ever did wrong. One from the method's own
states tells what it does wrong from there on. Any method of `methods` can be measured.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ...physics.simulate import Simulator
from ...physics.simulate.characters import PosedCharacters
from ...physics.simulate.history import StepHistory
from ...physics.simulate.simulator import Stepped
from ...scene.assets import Motion
from ...scene.kinematics import first_place
from .kept_parts import NOTHING_KEPT, KeptParts
from .methods import EvaluationScene, Method, TakeSet
from .metrics import mean_square

STATES = 2  # of a method, that its window begins with

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
    """Windows of which some steps are simulated.

    Attributes:
        steps: how many of each, shape (N,).
        figures: of these, as `Departures` has them, shape (3, F, N).
        state: after the last one, of the windows that have begun and not ended; None without any.
    """

    steps: Tensor
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
        windows: of three frames or more; the method is finite in all.
        mass: of the vertices [kg], shape (V,).
        advanced: called with the number of frames that were simulated since the last call.
        kept: where simulations go on from, as far as they were simulated before.
    """
    counts = [len(window.x) - STATES for window in windows]
    found = torch.full((3, max(counts), len(windows)), torch.nan, dtype=torch.float64)
    steps = torch.zeros(len(windows), dtype=torch.long)
    last: dict[int, StepHistory] = {}
    begun = kept.get("windows", _Begun, windows[0].x.device)
    if begun:
        found, steps = begun.figures.cpu(), begun.steps.cpu()
        last = dict(zip(_going_on(steps, counts), begun.state.split() if begun.state else []))
        advanced(int(steps.sum()))

    def keep() -> None:
        states = [last[number] for number in _going_on(steps, counts)]
        kept.put("windows", _Begun(steps, found, StepHistory.concatenated(states) if states else None))

    for each in _simulated(simulator, windows, steps.tolist(), last):
        places = [(windows[each.shot], each.step)]
        away, moved = stacked(places, 0) - each.state.last, each.state.last - each.past.last
        lbs = each.state.lbs + each.state.root - each.past.lbs - each.past.root
        missed = [away, stacked(places, 0) - stacked(places, 1) - moved, lbs - moved]
        found[:, each.step - STATES, each.shot] = torch.stack(
            [mean_square(part, mass.double())[0] for part in missed]
        ).cpu()
        steps[each.shot], last[each.shot] = each.step - STATES + 1, each.state
        if steps[each.shot] == counts[each.shot]:
            del last[each.shot]
        advanced(1)
        if kept.due:
            keep()
    keep()
    return Departures(*found)


def _going_on(steps: Tensor, counts: Sequence[int]) -> list[int]:
    """Return the windows of which some steps were taken, and not all."""
    return [number for number, (taken, count) in enumerate(zip(steps.tolist(), counts)) if 0 < taken < count]


def _simulated(
    simulator: Simulator, windows: Sequence[MethodWindow], taken: Sequence[int], last: Mapping[int, StepHistory]
) -> Iterator[Stepped]:
    """Yield the simulator's steps to the frames of windows, each numbered by its frame, as they are solved.

    Args:
        taken: how many steps of each window are not taken again.
        last: the state after these, where there are any and more are to come.
    """
    ahead = [range(STATES + count, len(window.x)) for count, window in zip(taken, windows)]

    def poses_at(places: Sequence[tuple[int, int]]) -> PosedCharacters:
        return poses_of(simulator, [(windows[number], frame) for number, frame in places])

    own = (last.get(number) or history(simulator, [(window, STATES)]) for number, window in enumerate(windows))
    return simulator.carry_on(own, ahead, poses_at)


@torch.no_grad()
def continuations(
    simulator: Simulator, windows: Sequence[MethodWindow], advanced: Callable[[int], object]
) -> Iterator[tuple[int, Tensor]]:
    """Yield the simulator's positions in windows, from the first two states of each on, as soon as they are known.

    Args:
        windows, advanced: as for `departures`.

    Yields:
        The index of a window, and positions in the world [m], float64, shape (L, V, 3); the first two are its own.
    """
    found = [[*window.x[:STATES]] for window in windows]
    for each in _simulated(simulator, windows, [0] * len(windows), {}):
        own = found[each.shot]
        own.append(each.state.last[..., 0])
        advanced(1)
        if len(own) == len(windows[each.shot].x):
            yield each.shot, torch.stack(own)


def poses_of(simulator: Simulator, places: Sequence[Place]) -> PosedCharacters:
    """Return the characters of N places."""
    return simulator.poser.poses_at([(window.motion, frame) for window, frame in places])


def stacked(places: Sequence[Place], back: int) -> Tensor:
    """Return the positions (V, 3, N) so many frames before each place."""
    return torch.stack([window.x[frame - back] for window, frame in places], dim=-1)


def history(simulator: Simulator, places: Sequence[Place]) -> StepHistory:
    """Return the method's own two states before each place."""
    poses = poses_of(simulator, [(window, frame - 1) for window, frame in places])
    at = poses.root, poses.lbs
    return StepHistory(stacked(places, 1), stacked(places, 2), *at, matrices=poses.matrices)
