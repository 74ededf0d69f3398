# SPDX-License-Identifier: Apache-2.0
"""Evaluate models and baselines as 'ssilk evaluate' does, and group those of one garment and method as seeds."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import mean, stdev

from baselines.evaluation import open_network

from ssilk_core.cli import evaluate as verb
from ssilk_core.cli.main import parser
from ssilk_core.errors import fail
from ssilk_core.events import silent
from ssilk_core.quality.evaluation.asked import EvaluationOptions
from ssilk_core.quality.evaluation.tables import tables

from .records import Row, Settings, read_records, settings_of


def measured(options: argparse.Namespace) -> tuple[list[Row], dict[str, Settings]]:
    """Return the figures of all models, evaluated now or read from records, and the models' settings by name."""
    if options.records:
        rows, models, options.hardware = read_records(options.records)
        return rows, models
    rows = [{**row, "sequence": options.sequence} for row in evaluated(options)[0]]
    return rows, {path.stem: settings_of(path) for path in options.models}


def evaluated(options: argparse.Namespace, *, probes: bool = False) -> tuple[list[Row], str]:
    """Return the figures of all models, and their tables; stops and loops only for `probes`."""
    if not options.models:
        fail(options.table, "no model", "this is measured on models", "name files of 'ssilk train'")
    names = [path.stem for path in options.models]
    if len(set(names)) != len(names):
        fail(options.table, "several models of one name", "figures go by their names")
    for name in ("stage", "motions"):
        if not getattr(options, name):
            fail(options.table, f"no --{name}", "models are evaluated with it")
    named = ("stage", "motions", "index", "reference", "device")
    given = [(f"--{name}", value) for name in named if (value := getattr(options, name)) is not None]
    words = [word for pair in given for word in pair]
    words += ["--clips", *options.clips] if options.clips else []
    command = parser().parse_args([str(word) for word in ("evaluate", *options.models, *words)])
    asked = EvaluationOptions(sequence=options.sequence, stops=0, loop=0, linearised=0)
    if probes:
        asked = EvaluationOptions(
            sequence=options.sequence, minimum=options.minimum, simulate=options.simulate_stops, loop=options.loop
        )
    results = verb.evaluated(command, asked, open_network, silent, exact=options.exact)
    return results.figures, tables([row for _, row in results.rows])


@dataclass(frozen=True, eq=False)
class Cell:
    """Figures of the seeds of one method on one garment and split."""

    rows: Sequence[Row]

    def values(self, path: Sequence[str]) -> list[float]:
        """Return a figure of each seed, by the names that lead to it; nothing where it is lacking."""
        found = []
        for row in self.rows:
            value = row["figures"]
            for name in path:
                value = value and value.get(name)  # records of before lack what is new
            found += [] if value is None else [value]
        return found

    def shown(self, path: Sequence[str], form: str = ".4g") -> str:
        """Return a figure as text: its mean, with the standard deviation where there are several seeds."""
        values = self.values(path)
        spread = f" ± {stdev(values):.1g}" if len(values) > 1 and form == ".4g" else ""
        return f"{mean(values):{form}}{spread}" if values else ""


def cells(rows: Sequence[Row]) -> dict[tuple[str, str, str], Cell]:
    """Return figures by garment, method and split."""
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        method = row["method"].partition(" (")[0]
        groups.setdefault((row["garment"], method, row["split"]), []).append(row)
    return {key: Cell(group) for key, group in groups.items()}
