# SPDX-License-Identifier: Apache-2.0
"""Windows of clips from whose first two states the simulator goes on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ssilk_core.quality.evaluation.own_starts import Window
from ssilk_core.quality.evaluation.takes import Take

STATES = 2  # that a simulation starts from


def spread_windows(takes: Mapping[int, Take], count: int, after: Sequence[int]) -> list[Window]:
    """Return windows of one clip's takes, by number, in the middles of `count` equal parts of where they may start.

    A take that is too short for the last of the frames `after` is one window, unless it is too short for the first.
    """
    length = STATES + max(after)
    places = [
        (number, range(start, min(start + length, take.frame_count)))
        for number, take in takes.items()
        if take.frame_count >= STATES + min(after)
        for start in range(max(1, take.frame_count - length + 1))
    ]
    chosen = dict.fromkeys(((np.arange(count) + 0.5) / count * len(places)).astype(int).tolist() if places else ())
    return [places[place] for place in chosen]
