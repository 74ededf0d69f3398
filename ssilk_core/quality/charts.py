# SPDX-License-Identifier: Apache-2.0
"""Charts by matplotlib: panels of curves and points, as PNG files and as SVG text inside a page.

The output depends on the data alone: it holds no date and no random identifier. Most colours are those of Okabe and
Ito (https://jfly.uni-koeln.de/color), and each has a marker of its own, so that they differ for every kind of vision.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..files import replacing
from ..scene.assets import Floats

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#882255", "#6b6b6b", "#117733")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*", "<")
INK = "#22262b"  # text and axes; in a page they take the colour of the text around them
COLUMNS = 600  # a longer curve shows the largest and the smallest value of each of so many parts
MARKED = 12  # points of a named curve, about, that have a marker
DECADES = 1e3  # an axis that spans more than these has ticks at powers of ten alone, which have room
PLACES = ((5, 3, "left", "bottom"), (5, -3, "left", "top"), (-5, 3, "right", "bottom"), (-5, -3, "right", "top"))
"""Where words stand beside a point: a distance [points] and their alignment."""
BESIDE = 40  # pixels that words may reach beyond the axes
STYLE: Any = {
    "font.size": 8.5, "axes.titlesize": 9, "axes.titlelocation": "left", "axes.titleweight": "bold",
    "text.color": INK, "axes.labelcolor": INK, "axes.edgecolor": INK, "xtick.color": INK, "ytick.color": INK,
    "axes.spines.top": False, "axes.spines.right": False, "axes.linewidth": 0.6,
    "axes.grid": True, "grid.color": "#808080", "grid.alpha": 0.25, "grid.linewidth": 0.6,
    "lines.linewidth": 1.2, "lines.markersize": 4.5, "legend.frameon": False,
    "text.parse_math": False, "svg.fonttype": "none", "svg.hashsalt": "ssilk",
}  # fmt: skip


@dataclass(frozen=True, eq=False, kw_only=True)
class ChartPanel:
    """A pair of axes with curves and points.

    Attributes:
        x, y: what the axes show, with units.
        curves: by name, values along x and y.
        points: by name, (x, y, words beside the point).
        front: (x, y) of points that a dashed line joins.
        marks: letters at some places (x, y).
        levels: values of y with a line across.
        log_x: a logarithmic axis.
        linear_below: a logarithmic y axis, linear between minus and plus this value; None for a linear axis.
        span: the lowest and the highest y shown; None for all.
    """

    title: str = ""
    x: str
    y: str
    curves: Mapping[str, tuple[Sequence[float] | Floats, Sequence[float] | Floats]] = field(default_factory=dict)
    points: Mapping[str, Sequence[tuple[float, float, str]]] = field(default_factory=dict)
    front: Sequence[tuple[float, float]] = ()
    marks: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    levels: Sequence[float] = ()
    log_x: bool = False
    linear_below: float | None = None
    span: tuple[float, float] | None = None


def write_chart(path: Path, rows: Sequence[Sequence[ChartPanel]], *, size: tuple[float, float] = (4.5, 2.4)) -> None:
    """Write panels as a PNG.

    Args:
        rows: panels of each row.
        size: width and height of a panel [inches].

    Raises:
        SsilkError: the file cannot be written.
    """
    figure = _figure(rows, size)
    with replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=100, facecolor="white", metadata={"Software": None})


def svg_chart(label: str, rows: Sequence[Sequence[ChartPanel]], *, size: tuple[float, float] = (9.0, 1.15)) -> str:
    """Return panels as an <svg> element for a page; `label` says to readers who cannot see it what it shows."""
    from matplotlib import rc_context

    stream = StringIO()
    with rc_context(STYLE):  # identifiers and fonts are chosen while it is written
        nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
        _figure(rows, size).savefig(stream, format="svg", transparent=True, metadata=nothing)
    text = stream.getvalue()
    text = re.sub(r'<g id="[^"]*">', "<g>", text[text.index("<svg") :])  # names that repeat in each chart of a page
    text = text.replace(INK, "currentColor")
    return text.replace("<svg", f'<svg role="img" aria-label="{escape(label)}"', 1)


def _figure(rows: Sequence[Sequence[ChartPanel]], size: tuple[float, float]) -> Figure:
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    names = dict.fromkeys(name for row in rows for panel in row for name in (*panel.curves, *panel.points))
    looks = dict(zip(names, zip(COLOURS * len(names), MARKERS * len(names))))
    columns = max(map(len, rows))
    shared = all(len({panel.x for panel in column}) == 1 for column in zip(*rows))
    with rc_context(STYLE):
        height = size[1] * len(rows) + 0.3 + (0.4 if any(names) else 0.0)
        figure = Figure(figsize=(size[0] * columns, height), layout="constrained")
        FigureCanvasAgg(figure)
        grid = figure.subplots(len(rows), columns, squeeze=False, sharex="col" if shared else False)
        for number, row in enumerate(rows):
            for axes, panel in zip(grid[number], row):
                _draw(axes, panel, looks, bottom=not shared or number == len(rows) - 1)
        panels = [panel for row in rows for panel in row]
        if any(panel.points for panel in panels):
            figure.draw_without_rendering()  # room for words can be told once the axes have their places
            for axes, panel in zip(grid.flat, panels):
                _name_points(axes, panel)
        if any(names):
            _legend(figure, looks, lines=any(panel.curves for panel in panels))
        # Places are found once; a file with a layout still to be found would be drawn twice.
        if layout := figure.get_layout_engine():
            layout.execute(figure)
        figure.set_layout_engine("none")
    return figure


def _draw(axes: Axes, panel: ChartPanel, looks: Mapping[str, tuple[str, str]], *, bottom: bool) -> None:
    axes.set_title(panel.title)
    axes.set_ylabel(panel.y)
    if bottom:
        axes.set_xlabel(panel.x)
    _scale(axes, panel)
    for level in panel.levels:
        axes.axhline(level, color=INK, linewidth=0.6, zorder=1)
    for name, (x, y) in panel.curves.items():
        (colour, marker), shown = looks[name], peaks(np.asarray(y))
        marker = marker if name or len(shown) == 1 else ""
        places = np.asarray(x)[shown], np.asarray(y)[shown]
        axes.plot(*places, color=colour, marker=marker, markevery=-(-len(shown) // MARKED))
    if panel.front:
        axes.plot(*zip(*panel.front), color=INK, linestyle="--", linewidth=0.8, zorder=1)
    for name, group in panel.points.items():
        colour, marker = looks[name]
        axes.plot([x for x, _, _ in group], [y for _, y, _ in group], color=colour, marker=marker, linestyle="")
    for text, place in panel.marks.items():
        axes.plot(*place, color=COLOURS[1], marker="o", linestyle="")
        axes.annotate(text, place, xytext=(4, 3), textcoords="offset points", fontweight="bold")
    if panel.span:
        axes.set_ylim(*panel.span)


def _scale(axes: Axes, panel: ChartPanel) -> None:
    """Set the scales that are asked for, with round and plain numbers at their ticks."""
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

    plain = FuncFormatter(lambda value, _: f"{value:g}")
    if panel.log_x:
        axes.set_xscale("log")
        places = [x for group in panel.points.values() for x, _, _ in group] or [1.0]
        wide = max(places) > DECADES * min(places)
        axes.xaxis.set_major_locator(LogLocator(subs=(1,) if wide else (1, 2, 5)))
        axes.xaxis.set_major_formatter(plain)
        axes.xaxis.set_minor_formatter(NullFormatter())
    else:
        axes.xaxis.set_major_locator(MaxNLocator(nbins="auto", steps=(1, 2, 5, 10)))
    if panel.linear_below is not None:
        axes.set_yscale("symlog", linthresh=panel.linear_below)
        axes.yaxis.set_major_formatter(plain)


def _name_points(axes: Axes, panel: ChartPanel) -> None:
    """Write the words of points beside them, the last group first; words that find no room are left out."""
    taken: list[Any] = []
    for x, y, text in (point for group in reversed([*panel.points.values()]) for point in group if point[2]):
        for across, up, to, at in PLACES:
            words = axes.annotate(
                text, (x, y), xytext=(across, up), textcoords="offset points", ha=to, va=at, fontsize=7
            )
            box = words.get_window_extent()
            inside = axes.bbox.x0 < box.x0 and box.x1 < axes.bbox.x1 + BESIDE
            if inside and not any(box.overlaps(other) for other in taken):
                taken.append(box)
                break
            words.remove()


def _legend(figure: Figure, looks: Mapping[str, tuple[str, str]], *, lines: bool) -> None:
    from matplotlib.lines import Line2D

    named = {name: look for name, look in looks.items() if name}
    style: Any = "-" if lines else ""
    handles = [Line2D([], [], color=colour, marker=marker, linestyle=style) for colour, marker in named.values()]
    figure.legend(handles, list(named), loc="outside lower center", ncols=max(1, min(len(named), 4)))


def peaks(values: Floats) -> list[int]:
    """Return the numbers of the values (N,) that a curve goes through, at most about twice `COLUMNS` of them.

    They are the largest and the smallest of each part, and both ends.
    """
    if len(values) <= COLUMNS:
        return list(range(len(values)))
    parts = np.array_split(np.arange(len(values)), COLUMNS)
    kept = {int(part[find(values[part])]) for part in parts for find in (np.argmin, np.argmax)}
    return sorted({0, *kept, len(values) - 1})
