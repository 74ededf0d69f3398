# SPDX-License-Identifier: Apache-2.0
"""Bodies of one stage by weights of its shapes: "hero.usd:tall=1,heavy=0.5", or "tall=1" beside a stage."""

from __future__ import annotations

import re
from collections.abc import Mapping
from itertools import count, product
from math import isfinite, isqrt
from pathlib import Path

from ..errors import fail
from ..files import USD_NAMES, split_body, split_location

ALL_CORNERS = 4  # shapes, up to which bodies at all corners of the box of weights are few
ALLOWED = "a body of a stage is named as STAGE:SHAPE=WEIGHT,..., such as hero.usd:tall=1,heavy=0.5"


def need_weights(location: str) -> None:
    """Raise `SsilkError` where a location is a file that is there, a colon, and no weights of shapes."""
    named = re.fullmatch(rf"(.*?(?:{'|'.join(map(re.escape, USD_NAMES))})):(.+)", location, flags=re.DOTALL)
    if named and Path(named[1]).is_file():
        apart = "its SkelRoot is named apart, as in MODEL:/ROOT or by --root" if "/" in named[2] else ""
        fail(location, f"'{named[2]}' is no shape with a weight", ALLOWED, apart)


def is_shapes(text: str) -> bool:
    """Return whether a text is weights of shapes alone, "tall=1", which mean a stage that is named elsewhere."""
    return "=" in text and "/" not in text and Path(split_body(text)[0]).suffix not in USD_NAMES


def body_of(text: str, stage: str) -> str:
    """Return where a body is, "file[:SHAPE=WEIGHT,...]": weights alone are of the file of `stage`."""
    return f"{split_body(stage)[0]}:{text}" if is_shapes(text) else text


def parse_shapes(where: str, shapes: str) -> dict[str, float]:
    """Return weights by the names of shapes, as "tall=1,heavy=0.5" gives them.

    Raises:
        SsilkError: a name without a weight, a weight that is no number, or a name twice; `where` is its place.
    """
    found: dict[str, float] = {}
    for part in shapes.split(","):
        name, equals, text = (each.strip() for each in part.rpartition("="))
        try:
            weight = float(text)
        except ValueError:
            weight = float("nan")
        if not (name and equals and isfinite(weight)):
            fail(where, f"'{part}' is no shape with a weight", ALLOWED)
        if name in found:
            fail(where, f"two weights of the shape '{name}'", "each shape has one", "leave one out")
        found[name] = weight
    return found


def shapes_text(weights: dict[str, float]) -> str:
    """Return weights as text, whichever way they were written: names in order, numbers as short as they are."""
    return ",".join(f"{name}={weights[name]:.9g}" for name in sorted(weights))


def body_name(location: str) -> str:
    """Return what a body is called: its shapes, without a weight of one, "tall_heavy0.5"; else its file's stem."""
    file, shapes = split_body(split_location(location)[0])
    if not shapes:
        return Path(file).stem
    weights = parse_shapes(location, shapes)
    return "_".join(name if weight == 1 else f"{name}{weight:g}" for name, weight in weights.items())


def bodies_within(ranges: Mapping[str, tuple[float, float]]) -> tuple[list[str], list[str]]:
    """Return the bodies that stand for all that shapes make within ranges of weights, "tall=1,heavy=0.5".

    The first have one shape at an end of its range. The second are corners of the box of weights, which have all
    shapes at ends. The stage's own body, whose weights are zero, is left out, and so are weights that are zero.

    Args:
        ranges: the least weight and the most by the names of shapes; zero is between them.
    """
    alone = [{name: weight} for name, ends in ranges.items() for weight in ends if weight]
    corners = [
        {name: ends[at] for (name, ends), at in zip(ranges.items(), corner) if ends[at]}
        for corner in _balanced_corners(len(ranges))
    ]
    singles = [shapes_text(body) for body in alone]
    texts = [shapes_text(body) for body in corners if body]
    return singles, [text for text in dict.fromkeys(texts) if text not in singles]


def _balanced_corners(size: int) -> list[list[bool]]:
    """Return corners of a cube: all of few, else between two and four times as many as it has directions.

    Any three directions have all eight combinations of ends equally often, for which fewer corners than twice the
    directions do not suffice: the rows of a Hadamard matrix, which Paley makes of the squares modulo a prime, and
    the corners opposite to these.
    """
    if size <= ALL_CORNERS:
        return [list(ends) for ends in product((False, True), repeat=size)]
    prime = next(p for p in count(3, 4) if p + 1 >= size and all(p % divisor for divisor in range(2, isqrt(p) + 1)))
    squares = {number**2 % prime for number in range(prime)}
    rows = [[True] * (prime + 1)]
    rows += [[False, *((row - column) % prime in squares for column in range(prime))] for row in range(prime)]
    return [[end != opposite for end in row[:size]] for opposite in (False, True) for row in rows]
