# SPDX-License-Identifier: Apache-2.0
"""Numbers within a range."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from math import nan

from ...scene.kinematics import MAX_FPS, MIN_FPS


@dataclass(frozen=True)
class NumberRange:
    """The type of an option that takes a finite number from `low` to `high`."""

    low: float
    high: float
    kind: type[int] | type[float] = float

    def __call__(self, text: str) -> float:
        """Return the number that a text spells; raise `ArgumentTypeError` where it is none of these."""
        try:
            value = self.kind(text)
        except ValueError:
            value = nan
        if not self.low <= value <= self.high:
            whole = "whole " if self.kind is int else ""
            raise argparse.ArgumentTypeError(
                f"'{text[:40]}' is not a {whole}number from {self.low:g} to {self.high:g}"
            )
        return value


RATE = NumberRange(MIN_FPS, MAX_FPS)  # frames in a second
