# SPDX-License-Identifier: GPL-3.0-or-later
"""What a training's state and learning curve mean, in lines for people."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import Any

from ssilk_core.training.verdict import ADVICE, NO_DYNAMICS, percent, share_below

from .jobs import JobState

ENDED = {
    "done": "Trained for {done} iterations",
    "stopped": "Stopped at {done} of {total}; it can be resumed",
    "lost": "Ended without a word at {done} of {total}, perhaps with the machine; resume it",
    "waiting": "Waits until the trainings before it have ended",
}
IMPROVED = {
    "done": "Trained for {done} iterations, until it got no better",
    "stopped": "Finished after {done} iterations; it can go on and get better",
    "waiting": "Waits until other trainings have ended, and goes on",
}


def progress(state: JobState) -> str:
    """Return how far a training is."""
    if state.state == "failed":
        return state.error
    if state.alive and state.cancelled:
        return "Ends after its current step"
    ended = {**ENDED, **(IMPROVED if state.round else {})}
    if state.state in ended:
        return ended[state.state].format(done=state.done, total=state.total)
    if not state.total:
        return "Prepares the training"
    if state.seconds_left is None:
        return "Prepares to go on" if state.round else f"{state.done} of {state.total}"
    return f"{state.done} of {state.total}, {rounded(state.seconds_left)} left"


def rounded(seconds: float) -> str:
    """Return a duration as people estimate it."""
    minutes = max(1, round(seconds / 60))
    if seconds < 60:
        return f"{max(1, round(seconds))} s"
    return f"{minutes} min" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def improvement(state: JobState, curve: Mapping[str, Any]) -> list[str]:
    """Return in short lines what a training has reached and whether it goes on; none before its first validation."""
    if not (points := curve.get("points")):
        return []
    best = next((each for each in points if each.get("iteration") == state.checkpoint), points[-1])["validation"]
    skin = best.get("shown_skin") or {}
    shown, first = (each.get("mean") for each in (skin, points[0]["validation"].get("shown_skin") or {}))
    if shown is None:
        said = compared(best["total"], curve["lbs"]["total"])[0]
    else:
        before = f", {first:.2%} at first" if first is not None and first != shown else ""
        bare = f"; {skin['bare']:.2%} is bare" if "bare" in skin else ""
        said = f"{shown:.2%} of the covered skin shows{before}{bare}"
    if state.cancelled or not state.round:
        return [said]
    return [said, f"Gets better until you finish it: {rounded(state.spent)} so far"]


def findings(state: JobState, curve: Mapping[str, Any], *, moves: bool) -> list[tuple[str, bool]]:
    """Return what validations found so far, each line with whether it is a warning.

    Args:
        curve: what `read_curve` returns.
        moves: whether the garment has proxies, and so should learn to move by itself.
    """
    if not curve.get("points"):
        return [("No validation yet: too early to say what is being learned", False)] if state.alive else []
    score, lbs = curve["points"][-1]["validation"], curve["lbs"]
    found = [
        compared(score["total"], lbs["total"]),
        (f"{score['collisions']:.2%} of the vertices inside the body", False),
    ]
    if shown := score.get("shown_skin"):
        found.append(
            (f"{shown['mean']:.2%} of the covered skin shows, {shown['worst']:.2%} in the worst frame", False)
        )
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
    share = share_below(total, lbs)
    return (f"{percent(share)} {'less' if share >= 0 else 'more'} energy than linear blend skinning", share < 0)


def dynamics(moved: float) -> tuple[str, bool]:
    """Return whether dynamics are being learned.

    Args:
        moved: how far the garment is from hanging still, in the mean [m].
    """
    if moved < NO_DYNAMICS:
        return (ADVICE[0].upper() + ADVICE[1:], True)
    return (f"Dynamics are being learned: {moved * 1000:.0f} mm of motion of its own", False)
