# SPDX-License-Identifier: GPL-3.0-or-later
"""What a training's state and learning curve mean, in lines for people."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import Any

from ssilk_core.events import format_seconds
from ssilk_core.training.verdict import ADVICE, NO_DYNAMICS, curve_lbs

from .jobs import JobState

ENDED = {
    "done": "Trained for {done} iterations",
    "stopped": "Stopped at {done} of {total}; it can be resumed",
    "lost": "Ended without a word at {done} of {total}, perhaps with the machine; resume it",
    "waiting": "Waits until the trainings before it have ended",
}


def progress(state: JobState) -> str:
    """Return how far a training is."""
    if state.state == "failed":
        return state.error
    if state.state in ENDED:
        return ENDED[state.state].format(done=state.done, total=state.total)
    if not state.total:
        return "Prepares the training"
    left = "" if state.seconds_left is None else f", {format_seconds(state.seconds_left)} left"
    return f"Iteration {state.done} of {state.total}{left}"


def findings(state: JobState, curve: Mapping[str, Any], *, moves: bool) -> list[tuple[str, bool]]:
    """Return what validations found so far, each line with whether it is a warning.

    Args:
        curve: what `read_curve` returns.
        moves: whether the garment has proxies, and so should learn to move by itself.
    """
    if not curve.get("points"):
        return [("No validation yet: too early to say what is being learned", False)] if state.alive else []
    score, lbs = curve["points"][-1]["validation"], curve_lbs(curve)
    found = [
        compared(score["total"], lbs["total"]),
        (f"{score['collisions']:.2%} of the vertices inside the body", False),
    ]
    if shown := score.get("shown_skin"):
        found.append(
            (f"{shown['mean']:.2%} of the covered skin shows, {shown['worst']:.2%} in the worst frame", False)
        )
        if shown.get("bare") is not None:
            found.append((f"{shown['bare']:.2%} of it is bare: no cloth is near", False))
    if moves:
        found.append(dynamics(score["dynamics"]))
    if state.checkpoint is not None:
        found.append(
            (f"Best model: from iteration {state.checkpoint}; play it live or bake it to see it on your shot", False)
        )
    return found


def compared(total: float | None, lbs: float | None) -> tuple[str, bool]:
    """Return how the energy of a validation [J] compares with that of linear blend skinning."""
    if total is None or lbs is None or not isfinite(total - lbs):
        return ("The energy of the validation is not finite", True)
    share = 1 - total / lbs if lbs else 0.0
    return (f"{abs(share):.1%} {'less' if share >= 0 else 'more'} energy than linear blend skinning", share < 0)


def dynamics(moved: float) -> tuple[str, bool]:
    """Return whether dynamics are being learned.

    Args:
        moved: how far the garment is from hanging still, in the mean [m].
    """
    if moved < NO_DYNAMICS:
        return (ADVICE[0].upper() + ADVICE[1:], True)
    return (f"Dynamics are being learned: {moved * 1000:.0f} mm of motion of its own", False)
