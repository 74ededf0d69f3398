# SPDX-License-Identifier: Apache-2.0
"""Resumable sweep over variants of models."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from ...errors import SsilkError
from ...events import Countdown, Message, Reporter, silent
from ...scene.plain import from_plain
from ..kept_rows import KeptRows
from .collision_cost import CollisionCost
from .measure import VariantMeter
from .point import TradePoint
from .shot_method import GIVEN
from .variants import Variant

COSTS = "judging"  # where the file holds the costs of collisions


@dataclass
class Results:
    """Points of a sweep, each written when it is measured.

    Attributes:
        path: the file, or None.
        asked: identifies the models, scene and settings; a file with other values is begun anew.
        collision_costs: costs of detecting collisions, for the first model.
    """

    path: Path | None
    asked: Mapping[str, Any]
    collision_costs: Sequence[CollisionCost] = ()
    points: list[TradePoint] = field(default_factory=list)

    @property
    def kept(self) -> KeptRows[TradePoint]:
        """Where the points are kept."""
        names = ("garment", "model", "swept", "variant")
        return KeptRows(
            path=self.path,
            verb="trade",
            kind=TradePoint,
            names=names,
            inputs=self.asked,
            inputs_at="asked",
            rows_at="points",
            beside={COSTS: CollisionCost},
        )

    def resume(self, report: Reporter) -> None:
        """Read the points that an earlier run of the same sweep measured, as `KeptRows.known` does.

        Raises:
            SsilkError: the file is none of a sweep.
        """
        self.points = self.kept.known(report)
        costs = self.kept.told().get(COSTS, ()) if self.points else ()
        self.collision_costs = [from_plain(CollisionCost, each, figures=True) for each in costs]

    def found(self, model: str, variant: Variant) -> bool:
        """Return whether a variant has been measured."""
        asked = model, variant.swept, variant.name, variant.refine
        return any((p.model, p.swept, p.variant, p.refine) == asked for p in self.points)

    def add(self, point: TradePoint) -> None:
        """Add a point and write the file, which says that it is unfinished."""
        self.points.append(point)
        self._write(finished=False)

    def finish(self) -> None:
        """Write the file as a finished one."""
        self._write(finished=True)

    def _write(self, *, finished: bool) -> None:
        told = {"units": "SI, times in ms", COSTS: [asdict(each) for each in self.collision_costs]}
        self.kept.write(told, [asdict(each) for each in self.points], finished=finished)


def sweep(meter: VariantMeter, variants: Iterable[Variant], results: Results, report: Reporter = silent) -> int:
    """Measure the variants of a model that `results` lacks, and add each after its measurement.

    Those without a solver come first, and are counted. Each of the others tells its progress in frames.

    Return how many failed; each is warned of, and the others go on.
    """
    tried, failed = sorted(variants, key=lambda variant: variant.solved), 0
    missing = [variant for variant in tried if not results.found(meter.name, variant)]
    quick, left = (sum(not variant.solved for variant in each) for each in (tried, missing))
    told = Countdown(quick, report, done=quick - left)
    for variant in missing:
        try:
            point = _solved(meter, variant, report) if variant.solved else meter.point(variant)
        except SsilkError as error:
            failed += 1
            report(Message(f"{meter.name}, {variant.name}: not measured, {error}", "warning"))
        else:
            results.add(point)
        if not variant.solved:
            told()
    return failed


def _solved(meter: VariantMeter, variant: Variant, report: Reporter) -> TradePoint:
    """Measure a variant of which the solver computes the frames, and report each."""
    given = GIVEN * len(meter.take_set.takes) if variant.simulated else 0
    report(Message(f"{meter.name}, {variant.name}: the solver computes {meter.frames - given} frames"))
    return meter.point(variant, Countdown(meter.frames - given, report))
