# SPDX-License-Identifier: Apache-2.0
"""Two probes that energies of moving clips do not replace: does a garment come to rest, and does it drift?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from ...physics.energy import STATIC_TERMS
from .figures import LoopDrift, MinimumErrors, Settling
from .methods import EvaluationScene, Method, TakeSet
from .metrics import kinetic_energy, mean_square, ratio, settling_time
from .record import frame_energies
from .takes import EASE, Take, back_and_forth, stopped

REST_SPEED = 0.01  # [m/s], RMS over the mass
RUN_UP = 4.0  # [s] that are played before a stop, and of a clip that loops
LOOPS = 3


def stopped_takes(takes: Sequence[Take], fps: float, count: int, hold: float) -> tuple[list[Take], list[int]]:
    """Return takes that stop `count` times in each given one, spread evenly, and their first frames at rest."""
    found, first = [], []
    for take in takes:
        length = (take.frame_count - 1) / fps
        for number in range(1, count + 1):
            stop = length * number / (count + 1)
            before = max(0, int((stop - RUN_UP) * fps))
            motion, at_rest = stopped(take.motion.clip(before, take.frame_count), fps, stop - before / fps, hold)
            found.append(Take(take.clip, 0, motion))
            first.append(at_rest)
    return found, first


@torch.no_grad()
def settling(dressed: EvaluationScene, take_set: TakeSet, method: Method, first: Sequence[int]) -> list[Settling]:
    """Return what happens after each stop; the character of a take holds still from its frame `first` on."""
    return [_settling(dressed, take_set, method, take, at_rest) for take, at_rest in enumerate(first)]


def _settling(dressed: EvaluationScene, take_set: TakeSet, method: Method, take: int, first: int) -> Settling:
    count, mass, fps = take_set.takes[take].frame_count, dressed.energy.mass, dressed.fps
    path = method.vertices(take, range(first, count))
    kinetic = kinetic_energy(path, mass, fps)
    time = float(settling_time((2 * kinetic / mass.sum()).sqrt(), REST_SPEED, fps))
    last = range(count - 1, count)
    x, still = path[..., -1:], method.still(take, last)
    assert still is not None
    ours, theirs = (frame_energies(dressed, take_set, take, last, at) for at in (x, still))
    distance = float(mean_square(x - still, mass)) ** 0.5
    return Settling(
        stops=1,
        initial_kinetic_energy=float(kinetic[0]),
        final_kinetic_energy=float(kinetic[-1]),
        settled_share=float(time < torch.inf),
        settling_time=time,
        static_distance=distance,
        max_static_distance=distance,
        static_energy_excess=sum(float(ours[name] - theirs[name]) for name in STATIC_TERMS),
        gravity_excess=ratio(float(ours["gravity"] - theirs["gravity"]), dressed.weight),
    )


def last_frames(method: Method, takes: Sequence[Take]) -> Tensor:
    """Return the last positions of all takes (V, 3, N) [m], each about its own first root."""
    ends = [range(take.frame_count - 1, take.frame_count) for take in takes]
    return torch.cat([method.vertices(number, last) for number, last in enumerate(ends)], dim=-1)


def joined_settling(single: Sequence[Settling]) -> Settling | None:
    """Return the figures of several stops; None of none."""
    if not single:
        return None
    columns = _columns(single)
    distances = columns["static_distance"]
    changed = {
        "stops": len(single),
        "settling_time": float(columns["settling_time"].sort().values[(len(single) - 1) // 2]),
        "static_distance": _root_mean_square(distances),
        "max_static_distance": float(distances.max()),
    }
    return replace(single[0], **_means(columns) | changed)


def joined_minimum_errors(single: Sequence[MinimumErrors]) -> MinimumErrors | None:
    """Return the figures of several stops; None of none."""
    if not single:
        return None
    columns = _columns(single)
    changed = {
        "stops": len(single),
        "minimum_distance": _root_mean_square(columns["minimum_distance"]),
        "max_residual": float(columns["max_residual"].max()),
    }
    return replace(single[0], **_means(columns) | changed)


def _columns(figures: Sequence[Settling] | Sequence[MinimumErrors] | Sequence[LoopDrift]) -> dict[str, Tensor]:
    """Return each figure of several ones, shape (N,)."""
    names = vars(figures[0])
    return {name: torch.tensor([vars(one)[name] for one in figures], dtype=torch.float64) for name in names}


def _means(columns: Mapping[str, Tensor]) -> dict[str, Any]:
    return {name: float(values.mean()) for name, values in columns.items()}


def _root_mean_square(values: Tensor) -> float:
    return float(values.square().mean()) ** 0.5


def looped_takes(takes: Sequence[Take], fps: float, frames: int) -> tuple[list[Take], list[int]]:
    """Return takes whose first seconds loop for at least so many frames and three loops, and the loops' lengths."""
    least = max(frames, LOOPS * round(2 * (RUN_UP + EASE) * fps))
    pairs = [back_and_forth(take.motion.clip(0, round(RUN_UP * fps)), fps, least) for take in takes]
    return [Take(take.clip, 0, motion) for take, (motion, _) in zip(takes, pairs)], [length for _, length in pairs]


@torch.no_grad()
def loop_drift(
    dressed: EvaluationScene, take_set: TakeSet, method: Method, lengths: Sequence[int]
) -> list[LoopDrift]:
    """Return how the last loop of each take differs from its second."""
    return [_loop_drift(dressed, take_set, method, take, length) for take, length in enumerate(lengths)]


def _loop_drift(dressed: EvaluationScene, take_set: TakeSet, method: Method, take: int, length: int) -> LoopDrift:
    count = take_set.takes[take].frame_count
    second, last = range(length, 2 * length), range(count - length, count)
    paths = [method.vertices(take, range(loop.start - 2, loop.stop)) for loop in (second, last)]
    totals = [_total(dressed, take_set, take, loop, path) for loop, path in zip((second, last), paths)]
    drift, distance = totals[1] - totals[0], mean_square(paths[1] - paths[0], dressed.energy.mass)
    return LoopDrift(
        clips=1,
        frames=count,
        second_loop_total=totals[0],
        last_loop_total=totals[1],
        total_drift=drift,
        max_total_drift=drift,
        loop_distance=float(distance.mean()) ** 0.5,
    )


def _total(dressed: EvaluationScene, take_set: TakeSet, take: int, frames: range, path: Tensor) -> float:
    terms = frame_energies(dressed, take_set, take, frames, path)
    return sum(float(values.mean()) for name, values in terms.items() if name != "collisions")


def joined_loop_drift(single: Sequence[LoopDrift]) -> LoopDrift | None:
    """Return the figures of several clips; None of none."""
    if not single:
        return None
    columns = _columns(single)
    drifts = columns["total_drift"]
    changed = {
        "clips": len(single),
        "frames": int(columns["frames"].min()),
        "max_total_drift": float(drifts[drifts.abs().argmax()]),
        "loop_distance": _root_mean_square(columns["loop_distance"]),
    }
    return replace(single[0], **_means(columns) | changed)
