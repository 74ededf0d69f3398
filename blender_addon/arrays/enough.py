# SPDX-License-Identifier: GPL-3.0-or-later
"""Which of many motions are enough to train on: some of each kind, which their names tell."""

from __future__ import annotations

import re
from collections.abc import Sequence


def kind_of(name: str) -> str:
    """Return the first word of letters in a motion's name, in small ones: "1H_Melee_Chop.001" is a "melee"."""
    words = re.findall(r"[^\W\d_]+", re.sub(r"\d+[A-Za-z]?(?![A-Za-z])|(?<=[a-z])(?=[A-Z])", " ", name))
    return words[0].lower() if words else ""


def enough(names: Sequence[str], lengths: Sequence[float], most: float) -> list[int]:
    """Return which motions to take, in their order: of each kind one, then of each another, until `most` is reached.

    Args:
        lengths: of the motions [s].
        most: how long all may be together [s]; the first is taken in any case.
    """
    turns: dict[str, int] = {}
    ranks = []
    for name in names:
        kind = kind_of(name)
        turns[kind] = turns.get(kind, -1) + 1
        ranks.append(turns[kind])
    chosen: list[int] = []
    total = 0.0
    for index in sorted(range(len(names)), key=lambda index: (ranks[index], index)):
        if not chosen or total + lengths[index] <= most:
            chosen.append(index)
            total += lengths[index]
    return sorted(chosen)
