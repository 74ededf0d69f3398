# SPDX-License-Identifier: Apache-2.0
"""Resumable sweep over variants of models."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from ...errors import SsilkError
from ...events import Countdown, Message, Reporter, silent
from ...files import replacing
from .collision_cost import CollisionCost
from .measure import VariantMeter
from .point import TradePoint
from .shot_method import GIVEN
from .variants import Variant


@dataclass
class Results:
    """Points of a sweep, which are written to a file after each measurement.

    Attributes:
        path: the file, or None.
        asked: identifies the models, scene and settings; points of a file with another value are ignored.
        collision_costs: costs of detecting collisions, for the first model.
    """

    path: Path | None
    asked: Mapping[str, Any]
    collision_costs: Sequence[CollisionCost] = ()
    points: list[TradePoint] = field(default_factory=list)

    def resume(self, report: Reporter) -> None:
        """Read the points that an earlier run of the same sweep measured."""
        if self.path is None or not self.path.exists():
            return
        try:
            document = json.loads(self.path.read_text())
            points = [TradePoint.of(point) for point in document["points"]]
            same = document["asked"] == json.loads(json.dumps(self.asked))
        except (ValueError, TypeError, KeyError) as error:
            raise SsilkError(f"{self.path}: not results of 'ssilk trade' ({error}); name another file.") from error
        self.points = points if same else []
        if self.points:
            report(Message(f"{len(self.points)} variants were measured before and are reused"))

    def found(self, model: str, variant: Variant) -> bool:
        """Return whether a variant has been measured."""
        asked = model, variant.swept, variant.name, variant.refine
        return any((p.model, p.swept, p.variant, p.refine) == asked for p in self.points)

    def add(self, point: TradePoint) -> None:
        """Add a point and write the file."""
        self.points.append(point)
        if self.path is not None:
            document = {
                "units": "SI, times in ms",
                "asked": self.asked,
                "judging": [asdict(each) for each in self.collision_costs],
                "points": [asdict(each) for each in self.points],
            }
            with replacing(self.path) as temporary:
                temporary.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")


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
