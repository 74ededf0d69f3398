# SPDX-License-Identifier: Apache-2.0
"""Points of a trade as a picture: error and energy over each cost, with the front that no variant passes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..files import replacing
from .point import SECONDS, TradePoint, front

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw

WIDTH, HEIGHT, LEFT, TOP, GAP, LEGEND = 520, 400, 70, 60, 80, 40  # of panels and around them [pixels]
COLOURS = ("#2c3e50", "#2980b9", "#27ae60", "#8e44ad", "#d68910", "#16a085", "#7f8c8d", "#c0392b")
GRID, TEXT, FRONT = "#e4e4e4", "#444444", "#c9c9c9"
COSTS = {
    "milliseconds": ("ms a frame", 1.0),
    "shot_bytes": (f"MB of a shot of {SECONDS} s", 1e-6),
    "model_bytes": ("MB of model", 1e-6),
}
ERRORS = {"position": ("RMS from the whole model [mm]", 1e3), "excess": ("excess energy [J]", 1.0)}
STEPS = ((300, (1,)), (4, (1, 2, 5)), (0, (1, 1.5, 2, 3, 4, 5, 6, 7, 8)))  # of ticks in a decade, by its range
LEAST = {"position": 1e-2, "excess": 1e-4}  # in the units above; what is less is drawn there


@dataclass(frozen=True)
class Axis:
    """A logarithmic axis from `low` to `high` over so many pixels from `start`."""

    low: float
    high: float
    start: float
    length: float

    @classmethod
    def over(cls, values: Sequence[float], start: float, length: float) -> Axis:
        """Return an axis that holds all values, with some room."""
        low, high = min(values), max(values)
        room = max((high / low) ** 0.06, 1.05)
        return cls(low / room, high * room, start, length)

    def place(self, value: float) -> float:
        """Return where a value lies [pixels]."""
        share = math.log(value / self.low) / math.log(self.high / self.low)
        return self.start + self.length * min(1.0, max(0.0, share))

    def ticks(self) -> list[float]:
        """Return round values within: decades, with 2 and 5 where there are few."""
        decades = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
        steps = next(steps for least, steps in STEPS if self.high / self.low > least)
        return [v for decade in decades for step in steps if self.low <= (v := step * 10.0**decade) <= self.high]


def write_plot(path: Path, points: Sequence[TradePoint]) -> None:
    """Draw points, coloured by what was swept; the front is marked, and named are its points and quality levels."""
    from PIL import Image, ImageDraw

    size = LEFT + len(COSTS) * (WIDTH + GAP), TOP + LEGEND + len(ERRORS) * (HEIGHT + GAP)
    image = Image.new("RGB", size, "white")
    pen = ImageDraw.Draw(image)
    colours = dict(zip(dict.fromkeys(point.swept for point in points), COLOURS))
    _legend(pen, colours)
    for row, error in enumerate(ERRORS):
        for column, cost in enumerate(COSTS):
            corner = LEFT + column * (WIDTH + GAP), TOP + LEGEND + row * (HEIGHT + GAP)
            _panel(pen, corner, points, cost, error, colours)
    with replacing(path) as temporary:
        image.save(temporary)


def _font(size: int = 13) -> Any:
    from PIL import ImageFont

    return ImageFont.load_default(size)


def _legend(pen: ImageDraw, colours: dict[str, str]) -> None:
    x = float(LEFT)
    for swept, colour in colours.items():
        pen.ellipse((x, 22, x + 10, 32), fill=colour)
        pen.text((x + 16, 18), swept, fill=TEXT, font=_font())
        x += 46 + pen.textlength(swept, font=_font())


def _panel(
    pen: ImageDraw,
    corner: tuple[int, int],
    points: Sequence[TradePoint],
    cost: str,
    error: str,
    colours: dict[str, str],
) -> None:
    """Draw one cost against one error; what the solver refined lies beyond, at the edge."""
    (name, unit), (title, scale) = COSTS[cost], ERRORS[error]
    places = [(unit * getattr(p, cost), max(LEAST[error], scale * getattr(p, error))) for p in points]
    shown = [place for place, point in zip(places, points) if not point.refine] or places
    x = Axis.over([place[0] for place in shown], corner[0], WIDTH)
    y = Axis.over([place[1] for place in shown], corner[1] + HEIGHT, -HEIGHT)
    _grid(pen, x, y, corner, f"{title} over {name}")
    best = front(places)
    pen.line([(x.place(places[index][0]), y.place(places[index][1])) for index in best], fill=FRONT, width=4)
    for index, (point, place) in enumerate(zip(points, places)):
        across, down = x.place(place[0]), y.place(place[1])
        colour, radius = colours[point.swept], 6 if index in best else 4
        pen.ellipse((across - radius, down - radius, across + radius, down + radius), fill=colour,
                    outline="black" if index in best else None)  # fmt: skip
        if index in best or point.swept == "level" or point.refine:
            pen.text((across + 8, down - 15), point.variant, fill=colour, font=_font(11))


def _grid(pen: ImageDraw, x: Axis, y: Axis, corner: tuple[int, int], title: str) -> None:
    left, top = corner
    pen.text((left, top - 22), title, fill="black", font=_font())
    for value in y.ticks():
        pen.line((left, y.place(value), left + WIDTH, y.place(value)), fill=GRID)
        pen.text((left - 8 - pen.textlength(f"{value:g}", font=_font(11)), y.place(value) - 7), f"{value:g}",
                 fill=TEXT, font=_font(11))  # fmt: skip
    for value in x.ticks():
        pen.line((x.place(value), top, x.place(value), top + HEIGHT), fill=GRID)
        pen.text((x.place(value) - 10, top + HEIGHT + 6), f"{value:g}", fill=TEXT, font=_font(11))
