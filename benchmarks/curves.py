# SPDX-License-Identifier: Apache-2.0
"""Draw the learning curves of training runs, and compare what runs reach in equal time.

    python benchmarks/curves.py plain=cape.safetensors warm=cape_warm.safetensors --hardware "NVIDIA H100 80GB HBM3"

Each run is a model written by 'ssilk train', under a name of its own if one is given; the curve lies beside it, one
point for each validation. Time is that of the training steps alone. A run counts as having reached a total from the
first validation at or under it: the best model is the one that is kept.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from helpers.reports import RESULTS, table, write_results

from ssilk_core.errors import fail
from ssilk_core.events import format_seconds
from ssilk_core.physics.energy import TERMS
from ssilk_core.quality.charts import COLOURS, ChartPanel, write_chart
from ssilk_core.training.curve import curve_path

NESTED = {
    "shows": ("shown_skin", "mean"),
    "limbs": ("shown_skin", "pierced"),
    "step energy": ("step_errors", "energy"),
    "step distance": ("step_errors", "distance"),
}  # parts of a validation, where measured
PANELS = ("total", *TERMS, "collisions", "dynamics", *NESTED)
UNITS = {
    "collisions": "share of vertices",
    "dynamics": "m",
    "shows": "share of covered skin",
    "limbs": "share of frames",
    "step distance": "m",
}  # of others: J
SHOWN = 0.9  # share of the values that a panel shows: the first ones would flatten all others


@dataclass(frozen=True, eq=False)
class Run:
    """The validations of one training: iterations, seconds and values, shape (points,), or (0,) if not measured.

    Linear blend skinning's total.
    """

    name: str
    iterations: np.ndarray
    seconds: np.ndarray
    values: dict[str, np.ndarray]
    lbs: float

    @property
    def best(self) -> np.ndarray:
        """Return the lowest total so far [J], shape (points,)."""
        return np.minimum.accumulate(self.values["total"])

    def best_by(self, *, seconds: float = np.inf, iterations: float = np.inf) -> float | None:
        """Return the lowest total that was seen by then; None before the first validation."""
        seen = self.best[(self.seconds <= seconds) & (self.iterations <= iterations)]
        return float(seen[-1]) if len(seen) else None

    def reached(self, total: float) -> int | None:
        """Return the first validation at or under a total."""
        under = np.flatnonzero(self.values["total"] <= total)
        return int(under[0]) if len(under) else None


def read_run(text: str) -> Run:
    """Read the run of "MODEL" or "NAME=MODEL".

    Raises:
        SsilkError: there is no curve beside the model, or it has no point yet.
    """
    name, _, model = text.rpartition("=")
    path = curve_path(model)
    if not path.is_file():
        fail(str(path), "no such file", "'ssilk train' writes it beside the model", "name a trained model")
    document = json.loads(path.read_text())
    points = document["points"]
    if not points:
        fail(str(path), "the curve has no point yet", "one validation at least is needed", "train longer")
    values = {key: np.array([point["validation"].get(key, 0.0) for point in points]) for key in PANELS}
    for key, (part, figure) in NESTED.items():
        measured = [(point["validation"].get(part) or {}).get(figure) for point in points]
        values[key] = np.zeros(0) if None in measured else np.array(measured)
    iterations, seconds = (np.array([point[key] for point in points]) for key in ("iteration", "seconds"))
    return Run(name or Path(model).stem, iterations, seconds, values, document["lbs"]["total"])


def bounds(values: Iterable[np.ndarray]) -> tuple[float, float]:
    """Return the range that a panel shows of several curves."""
    every = np.concatenate(list(values))
    return float(every.min()), float(np.quantile(every, SHOWN)) if len(every) > 1 else float(every.max() + 1)


def draw(path: Path, runs: list[Run]) -> None:
    """Draw each value of all runs, over iterations on the left and over minutes on the right, as a PNG."""
    rows = []
    for key in PANELS:
        having = [run for run in runs if run.values[key].any()]
        if not having:
            continue
        unit, span = UNITS.get(key, "J"), bounds(run.values[key] for run in having)
        along = {"iterations": [run.iterations for run in having], "minutes": [run.seconds / 60 for run in having]}
        rows.append([
            ChartPanel(title=key, x=x, y=unit, span=span,
                       curves={run.name: (place, run.values[key]) for run, place in zip(having, places)})
            for x, places in along.items()
        ])  # fmt: skip
    write_chart(path, rows, size=(4.2, 1.6))


def compare(runs: list[Run], totals: list[float]) -> str:
    """Return a table of what runs reach in equal time and iterations, and when they reach the totals [J]."""
    shared = min(float(run.seconds[-1]) for run in runs)
    times, iterations = [shared / 4, shared / 2, shared], min(int(run.iterations[-1]) for run in runs)
    header = ["run", "iterations", "time", "best total [J]", "linear blend skinning [J]"]
    header += [f"best within {format_seconds(time)}" for time in times]
    header += [f"best within {iterations} iterations", *(f"time (iterations) to {total:.4g} J" for total in totals)]
    return table(header, [_line(run, times, iterations, totals) for run in runs])


def _line(run: Run, times: list[float], iterations: int, totals: list[float]) -> list[str]:
    begun = [run.name, str(run.iterations[-1]), format_seconds(run.seconds[-1])]
    best = [*(run.best_by(seconds=time) for time in times), run.best_by(iterations=iterations)]
    arrivals = [run.reached(total) for total in totals]
    return [
        *begun,
        *(f"{value:.4g}" for value in (run.best[-1], run.lbs)),
        *("" if value is None else f"{value:.4g}" for value in best),
        *("never" if at is None else f"{format_seconds(run.seconds[at])} ({run.iterations[at]})" for at in arrivals),
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "runs", nargs="+", metavar="[NAME=]MODEL", help=f"trained models; up to {len(COLOURS)} are drawn"
    )
    parser.add_argument("--hardware", required=True, help="what the runs were trained on, for the foot of the table")
    parser.add_argument(
        "--totals", type=float, nargs="+", metavar="JOULES", help="(default: the total all runs reach)"
    )
    parser.add_argument("--name", default="curves", help="of the result files (default curves)")
    options = parser.parse_args()
    runs = [read_run(text) for text in options.runs]
    totals = options.totals or [max(float(run.best[-1]) for run in runs)]
    if len(runs) <= len(COLOURS):  # no more can be told apart
        draw(RESULTS / f"{options.name}.png", runs)
    figures = {
        run.name: {
            "iterations": run.iterations.tolist(),
            "seconds": run.seconds.tolist(),
            "linear blend skinning": run.lbs,
            **{key: values.tolist() for key, values in run.values.items() if len(values)},
        }
        for run in runs
    }
    write_results(options, compare(runs, totals), figures)


if __name__ == "__main__":
    main()
