# SPDX-License-Identifier: Apache-2.0
"""A sweep over variants of models that can be interrupted and continued."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from ..errors import SsilkError
from ..events import Message, Progress, Reporter, silent
from ..files import replacing
from .judging import Judged
from .measure import VariantMeter
from .point import TradePoint
from .variants import Variant


@dataclass
class Results:
    """Points of a sweep, written to a file after each of them.

    Attributes:
        path: the file, or None.
        asked: what was measured on what; points of a file with another value are not used.
        judging: costs of detecting collisions, for the first model.
    """

    path: Path | None
    asked: Mapping[str, Any]
    judging: Sequence[Judged] = ()
    points: list[TradePoint] = field(default_factory=list)

    def resume(self, report: Reporter) -> None:
        """Read the points that an earlier run of the same sweep has measured."""
        if self.path is None or not self.path.exists():
            return
        try:
            document = json.loads(self.path.read_text())
            points = [TradePoint(**point) for point in document["points"]]
            same = document["asked"] == json.loads(json.dumps(self.asked))
        except (ValueError, TypeError, KeyError) as error:
            raise SsilkError(f"{self.path}: not figures of 'ssilk trade' ({error}); name another file.") from error
        self.points = points if same else []
        if self.points:
            report(Message(f"{len(self.points)} variants were measured before and are kept"))

    def found(self, model: str, variant: Variant) -> bool:
        """Return whether a variant was measured."""
        return any((p.model, p.swept, p.variant) == (model, variant.swept, variant.name) for p in self.points)

    def add(self, point: TradePoint) -> None:
        """Add a point and write the file."""
        self.points.append(point)
        if self.path is not None:
            document = {
                "units": "SI, times in ms",
                "asked": self.asked,
                "judging": [asdict(each) for each in self.judging],
                "points": [asdict(each) for each in self.points],
            }
            with replacing(self.path) as temporary:
                temporary.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")


def sweep(meter: VariantMeter, variants: Iterable[Variant], results: Results, report: Reporter = silent) -> None:
    """Measure the variants of a model that `results` lacks, and add each when it is measured."""
    tried = list(variants)
    for done, variant in enumerate(tried):
        report(Progress(done, len(tried)))
        if not results.found(meter.name, variant):
            results.add(meter.point(variant))
