# SPDX-License-Identifier: Apache-2.0
"""Charts of a trade-off: errors over costs, with the Pareto front."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import isfinite

from ..charts import ChartPanel
from .point import SECONDS, TradePoint, front
from .variants import SIMULATOR, WHOLE

COSTS = {
    "making": ("time to make a frame, solver included [ms]", 1.0),
    "shot_bytes": (f"shot of {SECONDS} s [MB]", 1e-6),
    "model_bytes": ("model [MB]", 1e-6),
}
# Label, factor to its unit, and the value below which the axis is linear, so that it can show zero.
ERRORS = {
    "position": ("RMS distance from the whole model [mm]", 1e3, 0.1),
    "total": ("energy above the lowest [J]", 1.0, 1e-3),
    "mean_shown_skin": ("covered skin that shows [%]", 1e2, 1e-2),
    "mean_intersections": ("triangles that intersect others [%]", 1e2, 1e-2),
}
# Errors that compare networks; a distance is from one's own whole model.
ACROSS_MODELS = ("total", "mean_shown_skin", "mean_intersections")
NAMED = (WHOLE, "level", "refinement", "latents", SIMULATOR)  # sweeps whose points are all labelled


def trade_panels(points: Sequence[TradePoint], frames: Mapping[str, int]) -> list[list[ChartPanel]]:
    """Return a row of panels for each garment and error, with a panel for each cost.

    Each sweep has a colour. Full models, levels, shots of a solver and points of the Pareto front are labelled.

    Args:
        frames: number of frames of each clip that all points are of; empty where it is not known.
    """
    count = f", {sum(frames.values())} frames, {len(frames)} clip{'s' if len(frames) > 1 else ''}" if frames else ""
    garments = dict.fromkeys(point.garment for point in points)
    return [row for name in garments for row in _rows([p for p in points if p.garment == name], name + count)]


def _rows(points: Sequence[TradePoint], title: str) -> list[list[ChartPanel]]:
    """Return the rows of one garment."""
    errors = ERRORS if len({point.model for point in points}) == 1 else ACROSS_MODELS
    lowest = min(point.total for point in points)
    above = [replace(point, total=point.total - lowest) for point in points]
    measured = [error for error in errors if all(isfinite(getattr(point, error)) for point in above)]
    return [[_panel(above, cost, error, title) for cost in COSTS] for error in measured]


def _panel(points: Sequence[TradePoint], cost: str, error: str, title: str) -> ChartPanel:
    (x, unit), (y, scale, linear) = COSTS[cost], ERRORS[error]
    places = [(unit * getattr(point, cost), scale * getattr(point, error)) for point in points]
    best = front(places)
    groups: dict[str, list[tuple[float, float, str]]] = {}
    for index, (point, place) in enumerate(zip(points, places)):
        named = index in best or point.swept in NAMED
        groups.setdefault(point.swept, []).append((*place, _words(point, points[0].model) if named else ""))
    return ChartPanel(
        title=title if cost == next(iter(COSTS)) else "",
        x=x,
        y=y,
        points=groups,
        front=[places[index] for index in best],
        log_x=True,
        linear_below=linear,
    )


def _words(point: TradePoint, first: str) -> str:
    """Return the words beside a point: networks are told by their names, and so are what others than the first do."""
    if point.swept == WHOLE:
        return point.model
    return point.variant if point.model == first else f"{point.model}, {point.variant}"
