# SPDX-License-Identifier: Apache-2.0
"""What verbs share that take a quality level or a budget."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING

from ..events import Message, Reporter
from ..quality import QUALITIES, best_within, budget_of, in_units, quality_named
from ..reduction import ModelSize

if TYPE_CHECKING:
    from ..assets import Motion
    from ..checkpoint import ModelFile
    from ..reduction import Reduced, Reducer

NUMBERS = ("shapes", "joints", "influences")


def add_level(verb: argparse.ArgumentParser, size: str) -> None:
    """Add --quality and --budget; `size` says of what a budget in bytes is."""
    levels = "; ".join(f"{level.name}: {level.about}" for level in QUALITIES.values())
    verb.add_argument("--quality", choices=QUALITIES, help=f"level of quality ({levels})")
    verb.add_argument("--budget", metavar="AMOUNT", help=f"keep the most within 0.3ms for each frame, or {size}")


def level_size(quality: str | None, whole: ModelSize) -> ModelSize:
    """Return what a level keeps of a model; all without one."""
    return quality_named(quality).size.within(whole) if quality else whole


def lost(whole: ModelSize, found: Reduced) -> dict[str, object]:
    """Return what was kept of a model, and what that loses."""
    names = dict(zip(NUMBERS, ("blendshapes", "proxies", "influences")))
    return {
        **{names[name]: f"{getattr(found.size, name)} of {getattr(whole, name)}" for name in NUMBERS},
        "loses [mm RMS]": round(1000 * found.rms, 3),
        "loses at most [mm]": round(1000 * found.largest, 2),
    }


def spent(
    text: str,
    reducer: Reducer,
    most: ModelSize,
    motion: Motion,
    size: Callable[[ModelFile], float],
    report: Reporter,
) -> Reduced:
    """Return the best model within a budget, and say which it is.

    Args:
        most: what may be kept.
        motion: to time models with.
        size: gives the bytes that a model takes.

    Raises:
        SsilkError: nothing fits, or the text is no budget.
    """
    from ..cost import play_time
    from ..runtime import Player

    budget = budget_of(text)

    def cost(file: ModelFile) -> float:
        return size(file) if budget.unit == "bytes" else play_time(Player(file), motion).median

    choice = best_within(reducer, budget, cost, most)
    kept = choice.reduced.size
    report(Message(f"within {budget}: {kept.shapes} blendshapes, {kept.joints} proxies and {kept.influences} "
                   f"influences take {in_units(choice.cost, budget.unit)}"))  # fmt: skip
    return choice.reduced
