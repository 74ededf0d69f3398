# SPDX-License-Identifier: Apache-2.0
"""What energies of moving clips hide: whether a garment comes to rest, and whether it drifts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from .figures import Holds, Hung, Loops
from .methods import EvaluationScene, Method, TakeSet
from .metrics import kinetic_energy, mean_square, ratio, settling_time
from .record import frame_energies
from .takes import EASE, Take, back_and_forth, stopped

CALM = 0.01  # [m/s], RMS over the mass
RUN_UP = 4.0  # [s] that are played before a stop, and of a clip that loops
LOOPS = 3
STATIC = ("stretch", "bending", "gravity", "collision")


def stops(takes: Sequence[Take], fps: float, count: int, hold: float) -> tuple[list[Take], list[int]]:
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
def held(dressed: EvaluationScene, reel: TakeSet, method: Method, first: Sequence[int]) -> list[Holds]:
    """Return what happens after each stop; a take of the reel is at rest from its frame `first` on."""
    return [_held(dressed, reel, method, take, at_rest) for take, at_rest in enumerate(first)]


def _held(dressed: EvaluationScene, reel: TakeSet, method: Method, take: int, first: int) -> Holds:
    count, mass, fps = reel.takes[take].frame_count, dressed.energy.mass, dressed.fps
    path = method.vertices(take, range(first, count))
    kinetic = kinetic_energy(path, mass, fps)
    calm = float(settling_time((2 * kinetic / mass.sum()).sqrt(), CALM, fps))
    last = range(count - 1, count)
    x, still = path[..., -1:], method.still(take, last)
    assert still is not None
    ours, theirs = (frame_energies(dressed, reel, take, last, at) for at in (x, still))
    distance = float(mean_square(x - still, mass)) ** 0.5
    return Holds(
        stops=1,
        begun=float(kinetic[0]),
        kinetic=float(kinetic[-1]),
        settled=float(calm < torch.inf),
        settling=calm,
        distance=distance,
        furthest=distance,
        above=sum(float(ours[name] - theirs[name]) for name in STATIC),
        floats=ratio(float(ours["gravity"] - theirs["gravity"]), dressed.weight),
    )


def last_frames(method: Method, takes: Sequence[Take]) -> Tensor:
    """Return the last positions of all takes (V, 3, N) [m], each about its own first root."""
    ends = [range(take.frame_count - 1, take.frame_count) for take in takes]
    return torch.cat([method.vertices(number, last) for number, last in enumerate(ends)], dim=-1)


def joined_holds(single: Sequence[Holds]) -> Holds | None:
    """Return the figures of several stops; None of none."""
    if not single:
        return None
    columns = _columns(single)
    middle = columns["settling"].sort().values[(len(single) - 1) // 2]
    changed = {"stops": len(single), "settling": float(middle), "distance": _root_mean_square(columns["distance"])}
    return replace(single[0], **_means(columns) | changed | {"furthest": float(columns["distance"].max())})


def joined_hung(single: Sequence[Hung]) -> Hung | None:
    """Return the figures of several stops; None of none."""
    if not single:
        return None
    columns = _columns(single)
    changed = {"stops": len(single), "distance": _root_mean_square(columns["distance"])}
    return replace(single[0], **_means(columns) | changed | {"imbalance": float(columns["imbalance"].max())})


def _columns(figures: Sequence[Holds] | Sequence[Hung] | Sequence[Loops]) -> dict[str, Tensor]:
    """Return each figure of several ones, shape (N,)."""
    names = vars(figures[0])
    return {name: torch.tensor([vars(one)[name] for one in figures], dtype=torch.float64) for name in names}


def _means(columns: Mapping[str, Tensor]) -> dict[str, Any]:
    return {name: float(values.mean()) for name, values in columns.items()}


def _root_mean_square(values: Tensor) -> float:
    return float(values.square().mean()) ** 0.5


def looped(takes: Sequence[Take], fps: float, frames: int) -> tuple[list[Take], list[int]]:
    """Return takes whose first seconds loop for at least so many frames and three loops, and the loops' lengths."""
    least = max(frames, LOOPS * round(2 * (RUN_UP + EASE) * fps))
    pairs = [back_and_forth(take.motion.clip(0, round(RUN_UP * fps)), fps, least) for take in takes]
    return [Take(take.clip, 0, motion) for take, (motion, _) in zip(takes, pairs)], [length for _, length in pairs]


@torch.no_grad()
def drifted(dressed: EvaluationScene, reel: TakeSet, method: Method, lengths: Sequence[int]) -> list[Loops]:
    """Return how the last loop of each take differs from its second."""
    return [_drifted(dressed, reel, method, take, length) for take, length in enumerate(lengths)]


def _drifted(dressed: EvaluationScene, reel: TakeSet, method: Method, take: int, length: int) -> Loops:
    count = reel.takes[take].frame_count
    second, last = range(length, 2 * length), range(count - length, count)
    paths = [method.vertices(take, range(loop.start - 2, loop.stop)) for loop in (second, last)]
    totals = [_total(dressed, reel, take, loop, path) for loop, path in zip((second, last), paths)]
    drift, apart = totals[1] - totals[0], mean_square(paths[1] - paths[0], dressed.energy.mass)
    return Loops(
        clips=1,
        frames=count,
        second=totals[0],
        last=totals[1],
        drift=drift,
        most=drift,
        apart=float(apart.mean()) ** 0.5,
    )


def _total(dressed: EvaluationScene, reel: TakeSet, take: int, frames: range, path: Tensor) -> float:
    terms = frame_energies(dressed, reel, take, frames, path)
    return sum(float(values.mean()) for name, values in terms.items() if name != "collisions")


def joined_loops(single: Sequence[Loops]) -> Loops | None:
    """Return the figures of several clips; None of none."""
    if not single:
        return None
    columns = _columns(single)
    drifts = columns["drift"]
    changed = {
        "clips": len(single),
        "frames": int(columns["frames"].min()),
        "apart": _root_mean_square(columns["apart"]),
    }
    return replace(single[0], **_means(columns) | changed | {"most": float(drifts[drifts.abs().argmax()])})
