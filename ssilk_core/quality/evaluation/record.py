# SPDX-License-Identifier: Apache-2.0
"""Measures every frame of a take, in blocks, so that takes may be of any length."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ...physics.energy.frames import FRAMES_PER_CHUNK, energy_terms
from ...physics.intersections.cloth import IntersectionCounts
from ...physics.intersections.figures import EVERY
from ...physics.skin.covered_skin import ShownCounts
from .methods import EvaluationScene, Method, TakeSet
from .metrics import BINS, derivative, kinetic_energy, mean_square, principal_stretches, stretch_histogram

PAST = 3  # frames that a third difference looks back on
ERRORS = ("position error", "velocity error", "acceleration error")  # by order of the derivative


@dataclass(frozen=True, eq=False)
class TakeRecord:
    """One method over one take.

    Attributes:
        values: for each frame, float64 on the CPU, shape (N,): the terms of `energy.frames.energy_terms` [J],
            "kinetic energy" [J], "largest stretch", and mean squares of "jerk", of "static distance", that to the
            method's own static state, and of `ERRORS`. NaN where a take has too short a past.
        stretches: histogram of the larger principal stretch of all triangles.
        shown: the covered skin that shows, by time codes of the clip's motion.
        intersections: the triangles that intersect others, by time codes too, in every `EVERY`-th frame.
    """

    values: dict[str, Tensor]
    stretches: Tensor
    shown: ShownCounts
    intersections: IntersectionCounts


@torch.no_grad()
def recorded(
    dressed: EvaluationScene, take_set: TakeSet, method: Method, take: int, reference: Method | None = None
) -> TakeRecord:
    """Measure a method over a take, and its errors where there is a `reference`."""
    parts, shown, crossed, stretches = [], [], [], torch.zeros(BINS, dtype=torch.float64)
    ours, theirs = _Past(method, take), _Past(reference, take) if reference else None
    count, codes = take_set.takes[take].frame_count, take_set.takes[take].codes
    for start in range(0, count, FRAMES_PER_CHUNK):
        frames = range(start, min(start + FRAMES_PER_CHUNK, count))
        path, still = ours.joined(frames), method.still(take, frames)
        x = path[..., -len(frames) :]
        stretch = principal_stretches(dressed.columns(x))[0]
        stretches += stretch_histogram(stretch)
        states = dressed.covered.states(x, take_set.character(take, frames))
        shown.append(ShownCounts.of(states, codes[frames.start : frames.stop].tolist()))
        crossed.append(_intersections(dressed, x, frames, codes.tolist()))
        values = {
            **frame_energies(dressed, take_set, take, frames, path),
            **_moving(dressed, path, len(frames)),
            "largest stretch": stretch.amax(0),
            **({} if still is None else {"static distance": mean_square(x - still, dressed.energy.mass)}),
            **({} if theirs is None else _errors(dressed, path - theirs.joined(frames), len(frames))),
        }
        parts.append({name: value.double().cpu() for name, value in values.items()})
    joined = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    return TakeRecord(joined, stretches, ShownCounts.joined(shown), IntersectionCounts.joined(crossed))


def frame_energies(
    dressed: EvaluationScene, take_set: TakeSet, take: int, frames: range, path: Tensor
) -> dict[str, Tensor]:
    """Return `energy.frames.energy_terms` of the last frames of a path (V, 3, past + N), shape (N,)."""
    x, character = path[..., -len(frames) :], take_set.character(take, frames)
    body, joined = dressed.body.pose(character, exact=dressed.exact, limbs=False), path[..., -len(frames) - 2 :]
    down = x.new_tensor([0.0, -1.0, 0.0])
    return energy_terms(dressed.energy, x, dressed.lbs(character), dressed.contacts, body, joined, dressed.fps, down)


def _intersections(dressed: EvaluationScene, x: Tensor, frames: range, codes: list[float]) -> IntersectionCounts:
    """Count in those frames of positions (V, 3, N) that are so many from the take's first, told by its time codes."""
    chosen = [frame for frame in frames if frame % EVERY == 0]
    points = x[..., [frame - frames.start for frame in chosen]].permute(2, 0, 1).double().cpu().numpy()
    return dressed.intersections.counts(list(points), [codes[frame] for frame in chosen])


class _Past:
    """A method's positions block by block, each with the last frames of the one before."""

    def __init__(self, method: Method, take: int) -> None:
        self.method, self.take, self.tail = method, take, torch.zeros(0)

    def joined(self, frames: range) -> Tensor:
        x = self.method.vertices(self.take, frames)
        path = torch.cat([self.tail, x], dim=-1) if len(self.tail) else x
        self.tail = path[..., -PAST:].clone()
        return path


def _moving(dressed: EvaluationScene, path: Tensor, count: int) -> dict[str, Tensor]:
    mass, fps = dressed.energy.mass, dressed.fps
    return {
        "kinetic energy": _last(kinetic_energy(path, mass, fps), count),
        "jerk": _last(mean_square(derivative(path, 3, fps), mass), count),
    }


def _errors(dressed: EvaluationScene, away: Tensor, count: int) -> dict[str, Tensor]:
    mass, fps = dressed.energy.mass, dressed.fps
    orders = {name: derivative(away, order, fps) for order, name in enumerate(ERRORS)}
    return {name: _last(mean_square(vectors, mass), count) for name, vectors in orders.items()}


def _last(values: Tensor, count: int) -> Tensor:
    """Return the last `count` values, NaN before the first."""
    missing = max(0, count - len(values))
    return torch.cat([values.new_full((missing,), torch.nan), values[len(values) - count + missing :]])
