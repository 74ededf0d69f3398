# SPDX-License-Identifier: Apache-2.0
"""From records of takes to the figures of a split."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ..energy import TERMS
from .figures import Against, Figures, PoseNovelty
from .metrics import histogram_quantiles, ratio
from .record import TRUTH, TakeRecord

SHARES = (0.5, 0.95, 0.99)  # of triangles and frames, below which quantiles of stretch lie
NEAR, FAR = 0.5, 0.9  # quantiles up to which poses count as familiar, and from which as unfamiliar


@dataclass(frozen=True, eq=False)
class Tally:
    """Records of one method on some takes, by the takes' numbers, with the clip of each."""

    records: Mapping[int, TakeRecord]
    clips: Mapping[int, str]

    def each(self, name: str) -> Tensor:
        """Return a value of all frames, shape (N,)."""
        return torch.cat([record.values[name] for record in self.records.values()])

    def mean(self, name: str) -> float:
        """Return the mean of a value over the frames that have it."""
        return float(self.each(name).nanmean())

    def root(self, name: str) -> float:
        """Return the root of the mean of a squared value."""
        return self.mean(name) ** 0.5

    def totals(self) -> Tensor:
        """Return the total of each frame [J], shape (N,)."""
        return torch.stack([self.each(name) for name in TERMS]).sum(0)

    def only(self, takes: Sequence[int]) -> Tally:
        """Return the same of some of the takes."""
        return Tally({take: self.records[take] for take in takes if take in self.records}, self.clips)

    def clip_totals(self) -> tuple[float, float, float]:
        """Return the smallest, the median and the largest mean total of a clip [J]."""
        names = dict.fromkeys(self.clips[take] for take in self.records)
        means = torch.stack([self.only(takes_in(self.clips, [name])).totals().mean() for name in names])
        return float(means.min()), float(means.quantile(0.5)), float(means.max())


def takes_in(clips: Mapping[int, str], names: Collection[str]) -> list[int]:
    """Return the takes of some clips."""
    return [take for take, clip in clips.items() if clip in names]


def figures(tally: Tally, lbs: Tally, weight: float) -> Figures:
    """Return what a method comes to.

    Args:
        lbs: linear blend skinning on the same takes.
        weight: m g L of the garment [J].
    """
    jitter = tally.root("jerk")
    stretches = sum((record.stretches for record in tally.records.values()), torch.zeros(()))
    has_still = "motion" in next(iter(tally.records.values())).values
    return Figures(
        clips=len({tally.clips[take] for take in tally.records}),
        frames=len(tally.totals()),
        total=float(tally.totals().mean()),
        terms={name: tally.mean(name) for name in TERMS},
        collisions=tally.mean("collisions"),
        clip_totals=tally.clip_totals(),
        lift=ratio(tally.mean("gravity"), weight),
        kinetic=tally.mean("kinetic"),
        motion=tally.root("motion") if has_still else None,
        jitter=jitter,
        jitter_of_lbs=ratio(jitter, lbs.root("jerk")),
        stretches=(*histogram_quantiles(stretches, SHARES), float(tally.each("largest stretch").max())),
    )


def against(tally: Tally, truth: Tally, weight: float) -> Against | None:
    """Return how a method compares with the simulator, on the takes that it has; None where it has none of them."""
    ours = tally.only(list(truth.records))
    if not ours.records or "position" not in next(iter(ours.records.values())).values:
        return None
    theirs = truth.only(list(ours.records))
    total = float(theirs.totals().mean())
    position, velocity, acceleration = (ours.root(name) for name in TRUTH)
    return Against(
        frames=len(ours.totals()),
        total=total,
        excess=float(ours.totals().mean()) - total,
        floats=ratio(ours.mean("gravity") - theirs.mean("gravity"), weight),
        position=position,
        velocity=velocity,
        acceleration=acceleration,
        jitter=ratio(ours.root("jerk"), theirs.root("jerk")),
    )


def poses(tally: Tally, distances: Mapping[int, Tensor]) -> PoseNovelty:
    """Return what the distance of poses from those trained on [rad], by take (N,), does to a method."""
    far = torch.cat([distances[take] for take in tally.records]).double().cpu()
    totals = tally.totals()
    near, high = (far.quantile(share) for share in (NEAR, FAR))
    return PoseNovelty(
        mean=float(far.mean()),
        high=float(far.quantile(0.95)),
        familiar=float(totals[far <= near].mean()),
        unfamiliar=float(totals[far >= high].mean()),
    )
