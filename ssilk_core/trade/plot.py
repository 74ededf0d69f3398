# SPDX-License-Identifier: Apache-2.0
"""Charts of a trade-off: error and energy over each cost, with the Pareto front."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite

from ..charts import ChartPanel
from .point import SECONDS, TradePoint, front

COSTS = {
    "milliseconds": ("time of a frame [ms]", 1.0),
    "shot_bytes": (f"shot of {SECONDS} s [MB]", 1e-6),
    "model_bytes": ("model [MB]", 1e-6),
}
# Label, factor to its unit, and the value below which the axis is linear, so that it can show zero.
ERRORS = {
    "position": ("RMS distance from the whole model [mm]", 1e3, 0.1),
    "excess": ("energy above the whole model [J]", 1.0, 1e-3),
    "mean_shown_skin": ("covered skin that shows [%]", 1e2, 1e-2),
}
NAMED = ("as trained", "level", "refinement")  # sweeps whose points are all labelled


def trade_panels(points: Sequence[TradePoint]) -> list[list[ChartPanel]]:
    """Return a row of panels for each error, with a panel for each cost.

    Each sweep has a colour. The full model, levels, refined variants and points of the Pareto front are labelled.
    """
    measured = [error for error in ERRORS if all(isfinite(getattr(point, error)) for point in points)]
    return [[_panel(points, cost, error) for cost in COSTS] for error in measured]


def _panel(points: Sequence[TradePoint], cost: str, error: str) -> ChartPanel:
    (x, unit), (y, scale, linear) = COSTS[cost], ERRORS[error]
    places = [(unit * getattr(point, cost), scale * getattr(point, error)) for point in points]
    best = front(places)
    groups: dict[str, list[tuple[float, float, str]]] = {}
    for index, (point, place) in enumerate(zip(points, places)):
        named = index in best or point.swept in NAMED
        groups.setdefault(point.swept, []).append((*place, point.variant if named else ""))
    return ChartPanel(
        x=x, y=y, points=groups, front=[places[index] for index in best], log_x=True, linear_below=linear
    )
