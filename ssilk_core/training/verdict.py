# SPDX-License-Identifier: Apache-2.0
"""The result of a validation as a message."""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import TYPE_CHECKING, Any

from ..events import Message

if TYPE_CHECKING:
    from .validation import Score

# A rollout closer than this to the quasi-static state of each pose has learned no dynamics.
NO_DYNAMICS = 2e-3  # [m]
ADVICE = "nothing dynamic is being learned: train longer, or check that the motions move"


def curve_lbs(curve: Mapping[str, Any]) -> Mapping[str, float]:
    """Return the score of linear blend skinning in a learning curve; earlier versions named it "plain"."""
    found: Mapping[str, float] = curve["plain"] if "plain" in curve else curve["lbs"]
    return found


def non_finite_terms(score: Score) -> list[str]:
    """Return the names of the terms that are not finite."""
    return [name for name, value in score.terms.items() if not isfinite(value)]


def validation_message(iteration: int, score: Score, lbs: Score, moves: bool) -> Message:
    """Compare a score with that of linear blend skinning; warn if a garment that `moves` has learned no dynamics."""
    share = 1 - score.total / lbs.total
    terms = ", ".join(f"{name} {value:.4g}" for name, value in score.terms.items())
    text = (
        f"validation at {iteration}: total {score.total:.4g} J, "
        f"{share:.1%} under linear blend skinning's {lbs.total:.4g} J "
        f"({terms}), collisions {score.collisions:.2%}, motion of its own {score.dynamics * 1000:.0f} mm"
        f"{f', {score.shown_skin}' if score.shown_skin else ''}"
    )
    if score.dynamics < NO_DYNAMICS and moves:
        return Message(f"{text}; {ADVICE}", "warning")
    return Message(text)
