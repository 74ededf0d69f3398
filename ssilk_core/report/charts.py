# SPDX-License-Identifier: Apache-2.0
"""Charts as SVG text that stands in a page: lines over time, and points of two quantities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

from ..assets import Floats

WIDTH, LEFT, RIGHT = 860, 64, 12  # [pixels]
COLUMNS = 600  # a line has no more points: of several frames in one column the largest shows
COLOURS = ("#2f6f9f", "#c4622d", "#4f8a3c", "#8a4f9e", "#b03a48", "#6b6b6b")


def strip(title: str, unit: str, times: Floats, values: Floats, marks: Mapping[int, str], *, height: int = 96) -> str:
    """Return a chart of one quantity (F,) over time [s] (F,), with words at some frames."""
    low, high = min(0.0, float(values.min())), max(float(values.max()), 1e-30)
    high = high if high > low else low + 1

    def place(frame: float, value: float) -> tuple[float, float]:
        across = (frame - times[0]) / max(times[-1] - times[0], 1e-9)
        return LEFT + across * (WIDTH - LEFT - RIGHT), 20 + (high - value) / (high - low) * (height - 38)

    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in (place(times[f], values[f]) for f in peaks(values)))
    ruler = place(times[0], 0.0)[1]
    parts = [
        _text(LEFT, 13, f"{title} [{unit}]", "title"),
        f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{ruler:.1f}" y2="{ruler:.1f}" class="axis"/>',
        _text(LEFT - 6, 26, f"{high:.3g}", "end"),
        _text(LEFT - 6, height - 14, f"{low:.3g}", "end"),
        f'<polyline points="{line}" class="line"/>',
        _text(LEFT, height - 2, f"{times[0]:.2f} s", "small"),
        _text(WIDTH - RIGHT, height - 2, f"{times[-1]:.2f} s", "small end"),
    ]
    for frame, word in marks.items():
        x, y = place(times[frame], values[frame])
        label = f"{word}: {values[frame]:.4g} {unit} at {times[frame]:.2f} s"
        parts.append(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" class="mark"><title>{escape(label)}</title></circle>'
        )
        inner = x < WIDTH - RIGHT - 20
        parts.append(_text(x + 6 if inner else x - 6, max(y, 24), word, "small" if inner else "small end"))
    return _svg(height, f"{title} over time", parts)


def peaks(values: Floats) -> list[int]:
    """Return the frames that a line goes through: the largest of each of `COLUMNS` parts, and both ends."""
    columns = np.array_split(np.arange(len(values)), min(COLUMNS, len(values)))
    inner = [int(part[np.argmax(values[part])]) for part in columns]
    return sorted({0, *inner, len(values) - 1})


def scatter(
    title: str,
    axes: tuple[str, str],
    groups: Mapping[str, Sequence[tuple[float, float, str]]],
    front: Sequence[tuple[float, float]],
    *,
    height: int = 320,
) -> str:
    """Return a chart of points (x, y, words) in groups, the first axis logarithmic, with a line along a front."""
    points = [point for group in groups.values() for point in group]
    x, y = (np.array([point[axis] for point in points]) for axis in (0, 1))
    left, right = np.log10(max(x.min(), 1e-12)) - 0.05, np.log10(max(x.max(), 1e-12)) + 0.05
    low, high = min(0.0, y.min()), y.max() * 1.05 or 1.0

    def place(a: float, b: float) -> tuple[float, float]:
        across = (np.log10(max(a, 1e-12)) - left) / (right - left)
        return LEFT + across * (WIDTH - LEFT - RIGHT), 24 + (high - b) / (high - low) * (height - 64)

    parts = [_text(LEFT, 14, title, "title"), _text(WIDTH - RIGHT, height - 4, axes[0], "small end")]
    parts += [_text(LEFT - 6, 30, f"{high:.3g}", "end"), _text(LEFT - 6, height - 40, f"{low:.3g}", "end")]
    parts += [_text(LEFT, height - 4, f"{10**left:.3g}", "small"), _text(4, height - 22, axes[1], "small")]
    line = " ".join(f"{a:.1f},{b:.1f}" for a, b in (place(*point) for point in front))
    parts.append(f'<polyline points="{line}" class="front"/>')
    for colour, (name, group) in zip(COLOURS * len(groups), groups.items()):
        for a, b, words in group:
            cx, cy = place(a, b)
            hint = f"<title>{escape(f'{name}: {words}')}</title>"
            parts.append(f'<circle cx="{cx:.1f}" cy="{cy:.1f}" r="4" fill="{colour}">{hint}</circle>')
    return _svg(height, title, parts) + _legend(groups)


def _legend(names: Mapping[str, object]) -> str:
    words = (
        f'<span style="color:{colour}">&#9679;</span> {escape(name)}'
        for colour, name in zip(COLOURS * len(names), names)
    )
    return f'<p class="legend">{" &ensp; ".join(words)}</p>'


def _text(x: float, y: float, words: str, kind: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" class="{kind}">{escape(words)}</text>'


def _svg(height: int, label: str, parts: Sequence[str]) -> str:
    shown = f'viewBox="0 0 {WIDTH} {height}" role="img" aria-label="{escape(label)}"'
    return f"<svg {shown}>{''.join(parts)}</svg>"
