# SPDX-License-Identifier: Apache-2.0
"""The learning curve of a run: the validations and when they took place."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ..files import replacing
from .validation import Score

MAX_POINTS = 400


@dataclass(frozen=True)
class CurvePoint:
    """One validation.

    Attributes:
        iteration: steps done so far.
        seconds: time spent in steps, over all resumed parts of the run, without validation and writing [s].
        batch: energies of the last training batch [J].
        score: result of the validation.
    """

    iteration: int
    seconds: float
    batch: dict[str, float]
    score: Score


def curve_path(model: str | Path) -> Path:
    """Return the path of the learning curve for the run that writes `model`."""
    return Path(model).with_suffix(".curve.json")


def append_point(curve: list[CurvePoint], point: CurvePoint) -> list[CurvePoint]:
    """Return a curve with one more point; with more than `MAX_POINTS`, every second point is dropped."""
    curve = [*curve, point]
    return curve if len(curve) <= MAX_POINTS else curve[::2]


def write_curve(path: Path, curve: list[CurvePoint], lbs: Score) -> None:
    """Write {"lbs": score, "points": [{"iteration", "seconds", "batch", "validation"}, ...]}."""
    points = [
        {"iteration": p.iteration, "seconds": round(p.seconds, 3), "batch": p.batch, "validation": summary(p.score)}
        for p in curve
    ]
    with replacing(path) as temporary:
        temporary.write_text(json.dumps({"lbs": summary(lbs), "points": points}, indent=1))


def summary(score: Score) -> dict[str, Any]:
    """Return a score by name: terms and total [J], collisions, dynamics [m], skin, cloth, steps where measured."""
    parts = {
        "shown_skin": score.shown_skin,
        "intersections": score.intersections,
        "step_errors": score.step_errors,
    }
    measured: dict[str, Any] = {name: asdict(part) for name, part in parts.items() if part}
    for name, several in (("layers", score.layers), ("bodies", score.bodies)):
        measured |= {name: [asdict(part) for part in several]} if several else {}
    return {
        **score.terms, "total": score.total, "collisions": score.collisions, "dynamics": score.dynamics, **measured
    }  # fmt: skip
