# SPDX-License-Identifier: Apache-2.0
"""Result files, and the forms that tables show their figures in."""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from math import floor, log10
from pathlib import Path
from typing import Any

from ssilk_core.errors import fail
from ssilk_core.quality.kept_rows import UNFINISHED

RESULTS = Path(__file__).parents[1] / "results"
GARMENTS = {"cape": "cape", "fringe_skirt": "fringe skirt", "hooded_dress": "hooded dress"}
"""Garments that ship: the names of their files, and those that tables show."""


@cache
def document(name: str) -> Any:
    """Return a result file as it is.

    Raises:
        SsilkError: 'ssilk evaluate' or 'ssilk trade' has not finished it.
    """
    path = RESULTS / f"{name}.json"
    found = json.loads(path.read_text())
    if UNFINISHED in found:
        fail(path.name, "this measurement is unfinished", "tables are made of finished ones", "finish it")
    return found


def result(name: str) -> Any:
    """Return what a benchmark measured."""
    return document(name)["measured"]


def table(header: Sequence[str], rows: Sequence[Sequence[object]], left: int = 1) -> str:
    """Return a Markdown table whose first `left` columns are text, and the others numbers."""
    rule = ["---"] * left + ["---:"] * (len(header) - left)
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in (header, rule, *rows))


def fixed(value: float, places: int = 0, unit: float = 1.0) -> str:
    """Return a number in a unit, with a minus sign in place of a hyphen: -0.0042 in 1e-3 is −4.2."""
    text = f"{value / unit:,.{places}f}"
    return text.replace("-", "−") if any(digit in text for digit in "123456789") else text.lstrip("-")


def percent(value: float, places: int = 1) -> str:
    """Return a share in per cent."""
    return fixed(value, places, 0.01)


def digits(value: float, count: int = 3) -> str:
    """Return a number with so many significant digits, without an exponent: 0.0200, 16.4, 1,230."""
    if not value:
        return "0"
    rounded = float(f"{value:.{count}g}")
    return fixed(rounded, max(0, count - 1 - floor(log10(abs(rounded)))))


def duration(seconds: float) -> str:
    """Return a time as 8 min 05 s."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s"
