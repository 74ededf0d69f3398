# SPDX-License-Identifier: Apache-2.0
"""What a validation means, in words."""

from __future__ import annotations

from math import isfinite
from typing import TYPE_CHECKING

from ..events import Message

if TYPE_CHECKING:
    from .validation import Score

# A rollout closer than this to the quasi-static state of each pose has learned no dynamics worth the name.
NO_DYNAMICS = 2e-3  # [m]
ADVICE = "nothing dynamic is being learned: train longer, or check that the motions move"


def not_finite(score: Score) -> list[str]:
    """Return the names of the terms that are not finite."""
    return [name for name, value in score.terms.items() if not isfinite(value)]


def verdict(iteration: int, score: Score, lbs: Score, moves: bool) -> Message:
    """Return how a score compares with linear blend skinning's.

    A warning when a garment that `moves` has learned not to.
    """
    share = 1 - score.total / lbs.total
    terms = ", ".join(f"{name} {value:.4g}" for name, value in score.terms.items())
    text = (
        f"validation at {iteration}: total {score.total:.4g} J, "
        f"{share:.1%} under linear blend skinning's {lbs.total:.4g} J "
        f"({terms}), collisions {score.collisions:.2%}, motion of its own {score.dynamics * 1000:.0f} mm"
    )
    if score.dynamics < NO_DYNAMICS and moves:
        return Message(f"{text}; {ADVICE}", "warning")
    return Message(text)
