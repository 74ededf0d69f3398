# SPDX-License-Identifier: Apache-2.0
"""Averages records of takes to the figures of a split."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ...physics.energy import TERMS
from ...physics.intersections.cloth import ClothIntersections
from ...physics.intersections.figures import SelfIntersections
from ...physics.skin.covered_skin import CoveredSkin
from ...physics.skin.figures import ShownSkin
from .figures import Figures, PoseNovelty, ReferenceErrors
from .metrics import histogram_quantiles, ratio
from .record import ERRORS, TakeRecord

SHARES = (0.5, 0.95, 0.99)  # of triangles and frames, below which quantiles of stretch lie
NEAREST, FURTHEST = 0.5, 0.9  # quantiles of pose distance below and above which totals are averaged


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

    def shown_skin(self, covered: CoveredSkin) -> ShownSkin | None:
        """Return the share of the covered skin that shows; None where nothing is covered."""
        return covered.figures([(self.clips[take], record.shown) for take, record in self.records.items()])

    def intersections(self, cloth: ClothIntersections) -> SelfIntersections:
        """Return the share of triangles that intersect others of the garment."""
        return cloth.figures([(self.clips[take], record.intersections) for take, record in self.records.items()])

    def clip_totals(self) -> tuple[float, float, float]:
        """Return the smallest, the median and the largest mean total of a clip [J]."""
        names = dict.fromkeys(self.clips[take] for take in self.records)
        means = torch.stack([self.only(takes_in(self.clips, [name])).totals().mean() for name in names])
        return float(means.min()), float(means.quantile(0.5)), float(means.max())


def takes_in(clips: Mapping[int, str], names: Collection[str]) -> list[int]:
    """Return the takes of some clips."""
    return [take for take, clip in clips.items() if clip in names]


def figures(tally: Tally, lbs_jerk: float, weight: float, covered: CoveredSkin, cloth: ClothIntersections) -> Figures:
    """Return the figures of a method.

    Args:
        lbs_jerk: RMS jerk of linear blend skinning on the same takes [m/s3].
        weight: m g L of the garment [J].
        covered: the skin that it covers.
        cloth: what counts its triangles that intersect others.
    """
    jerk = tally.root("jerk")
    stretches = sum((record.stretches for record in tally.records.values()), torch.zeros(()))
    has_static_state = "static distance" in next(iter(tally.records.values())).values
    return Figures(
        clips=len({tally.clips[take] for take in tally.records}),
        frames=len(tally.totals()),
        total=float(tally.totals().mean()),
        terms={name: tally.mean(name) for name in TERMS},
        collisions=tally.mean("collisions"),
        shown_skin=tally.shown_skin(covered),
        intersections=tally.intersections(cloth),
        clip_totals=tally.clip_totals(),
        gravity_excess=ratio(tally.mean("gravity"), weight),
        kinetic_energy=tally.mean("kinetic energy"),
        static_distance=tally.root("static distance") if has_static_state else None,
        jerk=jerk,
        jerk_ratio=ratio(jerk, lbs_jerk),
        stretch_quantiles=(*histogram_quantiles(stretches, SHARES), float(tally.each("largest stretch").max())),
    )


def reference_errors(tally: Tally, simulator: Figures | None, weight: float) -> ReferenceErrors | None:
    """Compare a method with the simulator on the takes that both have; None where there are none.

    Args:
        simulator: its figures on these takes; None where it has not played.
        weight: m g L of the garment [J].
    """
    ours = tally.only([take for take, record in tally.records.items() if ERRORS[0] in record.values])
    if not (ours.records and simulator):
        return None
    position, velocity, acceleration = (ours.root(name) for name in ERRORS)
    return ReferenceErrors(
        frames=len(ours.totals()),
        reference_total=simulator.total,
        total_excess=float(ours.totals().mean()) - simulator.total,
        gravity_excess=ratio(ours.mean("gravity") - simulator.terms["gravity"], weight),
        position_error=position,
        velocity_error=velocity,
        acceleration_error=acceleration,
        jerk_ratio=ratio(ours.root("jerk"), simulator.jerk),
    )


def pose_novelty(tally: Tally, distances: Mapping[int, Tensor]) -> PoseNovelty:
    """Relate a method's totals to the distances of poses from the training's [rad], by take (N,)."""
    distance = torch.cat([distances[take] for take in tally.records]).double().cpu()
    totals = tally.totals()
    near, far = (distance.quantile(share) for share in (NEAREST, FURTHEST))
    return PoseNovelty(
        mean_distance=float(distance.mean()),
        p95_distance=float(distance.quantile(0.95)),
        nearest_half_total=float(totals[distance <= near].mean()),
        furthest_tenth_total=float(totals[distance >= far].mean()),
    )
