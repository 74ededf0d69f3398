# SPDX-License-Identifier: Apache-2.0
"""The figures of an evaluation as tables for people: aligned, and Markdown at the same time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import degrees, isfinite
from typing import Any

from ..energy import TERMS
from .figures import Against, Figures, Holds, Hung, Loops, PoseNovelty
from .run import ResultRow


def aligned(header: Sequence[str], rows: Sequence[Sequence[str]], words: int) -> str:
    """Return a Markdown table with columns of even width, the first ones with words and the others with figures."""
    widths = [max(map(len, column)) for column in zip(header, *rows)]

    def line(cells: Sequence[str]) -> str:
        padded = [cell.ljust(w) if n < words else cell.rjust(w) for n, (cell, w) in enumerate(zip(cells, widths))]
        return f"| {' | '.join(padded)} |"

    rule = ["-" * w if n < words else "-" * (w - 1) + ":" for n, w in enumerate(widths)]
    return "\n".join([line(header), line(rule), *map(line, rows)]) + "\n"


def tables(rows: Sequence[ResultRow]) -> str:
    """Return one table for each kind of figures that any row has, the methods of a split together."""
    places = {(row.garment, row.split): place for place, row in reversed(list(enumerate(rows)))}
    together = sorted(rows, key=lambda row: places[row.garment, row.split])
    return "\n".join(text for text in (_table(together, *kind) for kind in KINDS) if text)


def _table(
    rows: Sequence[ResultRow],
    pick: Callable[[Figures], Any],
    header: Sequence[str],
    cells: Callable[[Any], list[str]],
) -> str:
    lines = [
        [row.garment, row.split, row.method, *cells(part)] for row in rows if (part := pick(row.figures)) is not None
    ]
    return aligned(["garment", "split", "method", *header], lines, 3) if lines else ""


ENERGIES = ("frames", "total [J]", *TERMS, "inside the body", "gravity, of m g L", "clips: min / median / max")
MOVING = ("kinetic [J]", "own motion [mm]", "jitter [m/s3]", "of LBS", "stretch 50 / 95 / 99 / 100 %")
TRUTH = ("frames", "excess [J]", "simulator [J]", "floats, of m g L", "position [mm]", "velocity [m/s]",
         "acceleration [m/s2]", "jitter, of its")  # fmt: skip
HOLDS = ("stops", "kinetic at the stop [J]", "at the end", "settle", "within [s]", "off P, RMS [mm]", "at most",
         "over P [J]", "floats over P, of m g L")  # fmt: skip
HUNG = ("stops", "over the minimum [J]", "floats, of m g L", "linear blend skinning floats", "off it, RMS [mm]",
        "out of balance, at most [g]")  # fmt: skip
LOOPS = ("clips", "frames", "second loop [J]", "last [J]", "drift [J]", "at most", "apart [mm]")
POSES = ("from trained poses, mean [deg]", "95 %", "total, nearest half [J]", "furthest tenth [J]")


def _energies(f: Figures) -> list[str]:
    terms = [f"{f.terms[name]:.4g}" for name in TERMS]
    spread = " / ".join(f"{value:.3g}" for value in f.clip_totals)
    return [str(f.frames), f"{f.total:.4g}", *terms, f"{f.collisions:.2%}", f"{f.lift:+.1%}", spread]


def _moving(f: Figures) -> list[str]:
    motion = "" if f.motion is None else _millimetres(f.motion)
    stretches = " / ".join(f"{value:.3f}" for value in f.stretches)
    return [f"{f.kinetic:.3g}", motion, f"{f.jitter:.3g}", f"{f.jitter_of_lbs:.2f}", stretches]


def _truth(f: Against) -> list[str]:
    return [str(f.frames), f"{f.excess:.4g}", f"{f.total:.4g}", f"{f.floats:+.2%}", _millimetres(f.position),
            f"{f.velocity:.3f}", f"{f.acceleration:.2f}", f"{f.jitter:.2f}"]  # fmt: skip


def _holds(f: Holds) -> list[str]:
    settling = f"{f.settling:.2f}" if isfinite(f.settling) else "never"
    return [str(f.stops), f"{f.begun:.2g}", f"{f.kinetic:.2g}", f"{f.settled:.0%}", settling,
            _millimetres(f.distance), _millimetres(f.furthest), f"{f.above:.4f}", f"{f.floats:+.2%}"]  # fmt: skip


def _hung(f: Hung) -> list[str]:
    return [str(f.stops), f"{f.above:.4f}", f"{f.floats:+.2%}", f"{f.lbs:+.2%}", _millimetres(f.distance),
            f"{f.imbalance:.1g}"]  # fmt: skip


def _loops(f: Loops) -> list[str]:
    return [str(f.clips), str(f.frames), f"{f.second:.4g}", f"{f.last:.4g}", f"{f.drift:+.2g}", f"{f.most:+.2g}",
            _millimetres(f.apart)]  # fmt: skip


def _poses(f: PoseNovelty) -> list[str]:
    return [f"{degrees(f.mean):.1f}", f"{degrees(f.high):.1f}", f"{f.familiar:.4g}", f"{f.unfamiliar:.4g}"]


def _millimetres(value: float) -> str:
    return f"{1000 * value:.1f}"


KINDS: tuple[tuple[Callable[[Figures], Any], Sequence[str], Callable[[Any], list[str]]], ...] = (
    (lambda figures: figures, ENERGIES, _energies),
    (lambda figures: figures.truth, TRUTH, _truth),
    (lambda figures: figures, MOVING, _moving),
    (lambda figures: figures.holds, HOLDS, _holds),
    (lambda figures: figures.hung, HUNG, _hung),
    (lambda figures: figures.loops, LOOPS, _loops),
    (lambda figures: figures.poses, POSES, _poses),
)
