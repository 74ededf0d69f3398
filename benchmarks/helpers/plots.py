# SPDX-License-Identifier: Apache-2.0
"""Curves in panels with linear axes, as PNG."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ssilk_core.files import replacing

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageDraw import ImageDraw

COLOURS = ("#c0392b", "#2980b9", "#27ae60", "#8e44ad", "#d68910", "#16a085", "#7f8c8d", "#2c3e50")
GRID, TEXT = "#dddddd", "#444444"

Range = tuple[float, float]


def canvas(width: int, height: int) -> tuple[Image, ImageDraw]:
    """Return a white image [pixels] and what draws on it."""
    from PIL import Image, ImageDraw

    image = Image.new("RGB", (width, height), "white")
    return image, ImageDraw.Draw(image)


def save(image: Image, path: Path) -> None:
    """Write an image."""
    with replacing(path) as temporary:
        image.save(temporary)


@dataclass(frozen=True, eq=False)
class Panel:
    """A rectangle (left, top, right, bottom) [pixels] of an image that shows a range of x and y."""

    pen: ImageDraw
    box: tuple[float, float, float, float]
    x: Range
    y: Range

    def place(self, x: float, y: float) -> tuple[float, float]:
        """Return where a point lies on the image; what leaves the range stays at its edge."""
        left, top, right, bottom = self.box
        across, down = _share(x, self.x), 1 - _share(y, self.y)
        return left + across * (right - left), top + down * (bottom - top)

    def title(self, text: str) -> None:
        self.pen.text((self.box[0], self.box[1] - 16), text, fill="black")

    def across(self, y: float, label: str, colour: str = GRID) -> None:
        """Draw a labelled line at one height."""
        start, end = self.place(self.x[0], y), self.place(self.x[1], y)
        self.pen.line([start, end], fill=colour)
        self.pen.text((start[0] - 6 - self.pen.textlength(label), start[1] - 6), label, fill=TEXT)

    def up(self, x: float, label: str) -> None:
        """Draw a labelled line at one place along x."""
        start, end = self.place(x, self.y[0]), self.place(x, self.y[1])
        self.pen.line([start, end], fill=GRID)
        self.pen.text((start[0] - self.pen.textlength(label) / 2, start[1] + 4), label, fill=TEXT)

    def grid(self) -> None:
        """Draw round values of both axes."""
        for value in round_values(self.y, 4):
            self.across(value, f"{value:.4g}")
        for value in round_values(self.x, 5):
            self.up(value, f"{value:.6g}")

    def curve(self, points: Iterable[tuple[float, float]], colour: str) -> None:
        """Draw points (x, y), joined."""
        self.pen.line([self.place(*point) for point in points], fill=colour, width=2)


def _share(value: float, span: Range) -> float:
    low, high = span
    return min(1.0, max(0.0, (value - low) / (high - low if high > low else 1.0)))


def round_values(span: Range, about: int) -> list[float]:
    """Return about so many round values within a range."""
    low, high = span
    rough = (high - low if high > low else 1.0) / about
    unit = 10 ** math.floor(math.log10(rough))
    step = min((factor * unit for factor in (1, 2, 5, 10)), key=lambda value: abs(math.log(value / rough)))
    return [index * step for index in range(math.ceil(low / step), math.floor(high / step) + 1)]
