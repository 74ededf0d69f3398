# SPDX-License-Identifier: Apache-2.0
"""Tables of a trade-off's points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ..evaluation.tables import aligned
from .collision_cost import CollisionCost
from .point import SECONDS, TradePoint, front

HEADER = ("garment", "model", "swept", "variant", "size", "ms a frame", "95 %", "PyTorch", "solver", "memory [MB]",
          "model [MB]", f"{SECONDS} s shot [MB]", "total [J]", "excess [J]", "inside", "skin shows", "worst", "bare",
          "intersect", "most", "RMS [mm]", "velocity [mm/s]", "best at")  # fmt: skip
MARKS = {"making": "time", "shot_bytes": "shot", "model_bytes": "model"}


def caption(frames: Mapping[str, int], *, simulated: bool) -> str:
    """Return the words above a table: the frames of each clip that are measured, and where the simulator begins."""
    named = ", ".join(f"{count} of {name}" for name, count in frames.items())
    begins = "; the simulator goes on from the first two states of the garment's first network" if simulated else ""
    return f"all rows are of the same frames, the first {named}{begins}"


def table(points: Sequence[TradePoint]) -> str:
    """Return a row for each point; "best at" lists the costs on whose Pareto front of energy it is in its garment."""
    garments = [[p for p in points if p.garment == name] for name in dict.fromkeys(p.garment for p in points)]
    rows = [row for own in garments for row in _rows(own)]
    return aligned(HEADER, rows, 4)


def _rows(points: Sequence[TradePoint]) -> list[list[str]]:
    """Return the rows of one garment."""
    best = {mark: front([(getattr(p, cost), p.total) for p in points]) for cost, mark in MARKS.items()}
    return [_cells(point, [mark for mark, own in best.items() if row in own]) for row, point in enumerate(points)]


def collision_table(found: Sequence[CollisionCost]) -> str:
    """Return a row for each representation of the body."""
    header = ("collisions with", "vertices", "ms a frame", "collision [J]", "inside")
    rows = [
        [j.body, f"{j.vertices:,}", f"{j.milliseconds:.3g}", f"{j.collision:.3g}", f"{j.inside:.2%}"] for j in found
    ]
    return aligned(header, rows, 1)


def _cells(p: TradePoint, best: list[str]) -> list[str]:
    return [
        p.garment,
        p.model,
        p.swept,
        p.variant,
        f"{p.shapes}/{p.joints}/{p.influences}",
        f"{p.milliseconds:.3g}",
        f"{p.high:.3g}",
        "" if p.torch is None else f"{p.torch:.3g}",
        "" if p.solving is None else f"{p.solving:.3g}",
        f"{p.memory / 1e6:.3g}",
        f"{p.model_bytes / 1e6:.3g}",
        f"{p.shot_bytes / 1e6:.3g}",
        f"{p.total:.4g}",
        f"{p.excess:+.3g}",
        f"{p.collisions:.2%}",
        f"{p.shown_skin.mean:.3%}" if p.shown_skin else "",
        f"{p.shown_skin.worst:.2%}" if p.shown_skin else "",
        f"{p.shown_skin.bare:.2%}" if p.shown_skin else "",
        f"{p.intersections.mean:.2%}",
        f"{p.intersections.worst:.2%}",
        f"{1000 * p.position:.3g}",
        f"{1000 * p.velocity:.3g}",
        ", ".join(best),
    ]
