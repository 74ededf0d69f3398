# SPDX-License-Identifier: Apache-2.0
"""The result of a validation as a message."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import ceil, isfinite
from typing import TYPE_CHECKING

from ..events import Message
from ..physics.skin.figures import MOST_MEAN, MOST_WORST

if TYPE_CHECKING:
    from .validation import BodyScore, Score

# A rollout closer than this to the quasi-static state of each pose has learned no dynamics.
NO_DYNAMICS = 2e-3  # [m]
# A total that is higher than linear blend skinning's by less than this share of it differs by rounding.
WORSE = 1e-3
FEW = 0.5  # share of the iterations that were asked for, below which more minutes are advised
ADVICE = "nothing dynamic is being learned: train longer, or check that the motions move"
STATIC = "the time was up before dynamic training began, so that it has not learned to move"


def lower_by(score: Score, lbs: Score) -> float:
    """Return how much lower a total is than linear blend skinning's, as a share of it; negative if higher."""
    return share_below(score.total, lbs.total)


def share_below(total: float, lbs: float) -> float:
    """Return how much lower an energy [J] is than linear blend skinning's, as a share of its size.

    Both may be below zero, since gravity's part is measured from a height.
    """
    return (lbs - total) / abs(lbs) if lbs else 0.0


def percent(share: float) -> str:
    """Format the size of a share, of which no more than all can be: totals below zero are lower by "over 100%"."""
    return f"{abs(share):.1%}" if share <= 1 else "over 100%"


def is_worse(score: Score, lbs: Score) -> bool:
    """Return whether a model is worse than none: its total is above that of linear blend skinning."""
    return lower_by(score, lbs) < -WORSE


def worst_body(bodies: Sequence[BodyScore]) -> BodyScore | None:
    """Return the body of a family, or the fabric, on which least is won over linear blend skinning; None of none."""
    return min(bodies, key=lambda body: share_below(body.total, body.lbs), default=None)


def worse_bodies(model: str, score: Score) -> Iterator[Message]:
    """Yield a warning for each body of a family, its first left out, on which a model is worse than none."""
    for body in score.bodies:
        if share_below(body.total, body.lbs) < -WORSE:
            text = (
                f"its validation total of {body.total:.4g} J is above the {body.lbs:.4g} J of linear blend skinning"
            )
            yield Message(f"{model}: on {body.name} the model is worse than none: {text}", "warning")


def worse_message(model: str, score: Score, lbs: Score) -> Message:
    """Return the warning about a model that is worse than none."""
    return Message(
        f"{model}: the model is worse than none: its validation total of {score.total:.4g} J is "
        f"{-lower_by(score, lbs):.0%} above linear blend skinning's {lbs.total:.4g} J; train longer, or bake with "
        "--lbs",
        "warning",
    )


def shortcomings(
    model: str, score: Score, done: int, asked: int, seconds: float, moves: bool = True
) -> Message | None:
    """Return a warning where minutes sufficed for few of the iterations, or where the eye finds skin that shows.

    Args:
        done, asked: iterations that were done, and those that were asked for.
        seconds: duration of the whole run [s].
        moves: whether dynamic training had begun.
    """
    found, shown = [] if moves else [STATIC], score.shown_skin
    if done < FEW * asked:
        found.append(f"its minutes sufficed for {done} of {asked} iterations")
    if shown and shown.is_seen:
        found.append(
            f"{shown.mean:.2%} of the covered skin shows, {shown.worst:.1%} in the worst frame, {shown.bare:.2%} is "
            f"bare; what shows meets the eye at once above {MOST_MEAN:.2%}, or {MOST_WORST:.1%} in a frame"
        )
    if not found:
        return None
    more = ceil(seconds / 60 * max(2.0, asked / max(1, done)))
    found.append(f"'ssilk train' with the same options and '--resume --minutes {more}' goes on")
    return Message(f"{model}: " + "; ".join(found), "warning")


def non_finite_terms(score: Score) -> list[str]:
    """Return the names of the terms that are not finite, and of bodies whose total is not."""
    found = {**score.terms, **{body.name: body.total for body in score.bodies}}
    return [name for name, value in found.items() if not isfinite(value)]


def validation_message(iteration: int, score: Score, lbs: Score, moves: bool) -> Message:
    """Compare a score with that of linear blend skinning; warn if a garment that `moves` has learned no dynamics."""
    share = lower_by(score, lbs)
    terms = ", ".join(f"{name} {value:.4g}" for name, value in score.terms.items())
    text = (
        f"validation at {iteration}: total {score.total:.4g} J, "
        f"{percent(share)} {'under' if share >= 0 else 'above'} linear blend skinning's {lbs.total:.4g} J "
        f"({terms}), collisions {score.collisions:.2%}, motion of its own {score.dynamics * 1000:.0f} mm"
        + "".join(
            f", {part}" for part in (score.shown_skin, score.intersections, score.step_errors, *score.layers) if part
        )
        + "".join(f", {body.total:.4g} of {body.lbs:.4g} J on {body.name}" for body in score.bodies)
    )
    if score.dynamics < NO_DYNAMICS and moves:
        return Message(f"{text}; {ADVICE}", "warning")
    return Message(text)
