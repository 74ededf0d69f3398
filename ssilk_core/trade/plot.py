# SPDX-License-Identifier: Apache-2.0
"""The chart of a trade: error and energy over each cost, with the front that no variant passes."""

from __future__ import annotations

from collections.abc import Sequence

from ..charts import ChartPanel
from .point import SECONDS, TradePoint, front

COSTS = {
    "milliseconds": ("time of a frame [ms]", 1.0),
    "shot_bytes": (f"shot of {SECONDS} s [MB]", 1e-6),
    "model_bytes": ("model [MB]", 1e-6),
}
# What the y axes show, in which unit, and below which value they are linear: nothing is lost at zero.
ERRORS = {
    "position": ("RMS distance from the whole model [mm]", 1e3, 0.1),
    "excess": ("energy above the whole model [J]", 1.0, 1e-3),
}
WHOLE_NAMED = ("as trained", "level", "refinement")  # what is swept under these names has words beside each point


def trade_panels(points: Sequence[TradePoint]) -> list[list[ChartPanel]]:
    """Return a row of panels for each error and in it a panel for each cost.

    Points have one colour for each thing that was swept. The whole model, levels, refined variants and points of the
    front have their names beside them.
    """
    return [[_panel(points, cost, error) for cost in COSTS] for error in ERRORS]


def _panel(points: Sequence[TradePoint], cost: str, error: str) -> ChartPanel:
    (x, unit), (y, scale, linear) = COSTS[cost], ERRORS[error]
    places = [(unit * getattr(point, cost), scale * getattr(point, error)) for point in points]
    best = front(places)
    groups: dict[str, list[tuple[float, float, str]]] = {}
    for index, (point, place) in enumerate(zip(points, places)):
        named = index in best or point.swept in WHOLE_NAMED
        groups.setdefault(point.swept, []).append((*place, point.variant if named else ""))
    return ChartPanel(
        x=x, y=y, points=groups, front=[places[index] for index in best], log_x=True, linear_below=linear
    )
