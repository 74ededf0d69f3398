# SPDX-License-Identifier: Apache-2.0
"""The figures of an evaluation as Markdown tables with aligned columns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import degrees, isfinite
from typing import Any

from ...physics.energy import TERMS
from ...physics.intersections.figures import SelfIntersections
from ...physics.skin.figures import ShownSkin
from .figures import (
    ClosedLoop,
    Figures,
    LoopDrift,
    MinimumErrors,
    PoseNovelty,
    ReferenceErrors,
    ResultRow,
    Settling,
    SolverErrors,
)
from .solver_errors import AFTER


def aligned(header: Sequence[str], rows: Sequence[Sequence[str]], words: int) -> str:
    """Return a Markdown table with aligned columns; the first `words` ones hold text, the others numbers."""
    widths = [max(map(len, column)) for column in zip(header, *rows)]

    def line(cells: Sequence[str]) -> str:
        padded = [cell.ljust(w) if n < words else cell.rjust(w) for n, (cell, w) in enumerate(zip(cells, widths))]
        return f"| {' | '.join(padded)} |"

    rule = ["-" * w if n < words else "-" * (w - 1) + ":" for n, w in enumerate(widths)]
    return "\n".join([line(header), line(rule), *map(line, rows)]) + "\n"


def in_parts(header: Sequence[str], rows: Sequence[Sequence[str]], words: int, most: int) -> str:
    """Return the table of `aligned` as several of at most so many characters, each with the `words` first columns.

    A column that is wider by itself gets a table of its own.
    """
    widths = [max(map(len, column)) + len(" | ") for column in zip(header, *rows)]
    parts, free = list[list[int]](), 0
    for column, width in enumerate(widths[words:], words):
        if not parts or width > free:
            parts.append([])
            free = most - sum(widths[:words]) - len("|")
        parts[-1].append(column)
        free -= width
    chosen = [[*range(words), *part] for part in parts]
    return "\n".join(
        aligned([header[column] for column in part], [[row[column] for column in part] for row in rows], words)
        for part in chosen
    )


def tables(rows: Sequence[ResultRow], most: int | None = None) -> str:
    """Return a table for each kind of figures that any row has, with the methods of a split side by side.

    Args:
        most: characters of a line, for which wide tables come in parts; None for whole tables.
    """
    places = {(row.garment, row.split): place for place, row in reversed(list(enumerate(rows)))}
    together = sorted(rows, key=lambda row: places[row.garment, row.split])
    return "\n".join(text for text in (_table(together, *kind, most) for kind in KINDS) if text)


def _table(
    rows: Sequence[ResultRow],
    pick: Callable[[Figures], Any],
    header: Sequence[str],
    cells: Callable[[Any], list[str]],
    most: int | None,
) -> str:
    lines = [
        [row.garment, row.split, row.method, *cells(part)] for row in rows if (part := pick(row.figures)) is not None
    ]
    if not lines:
        return ""
    whole = ["garment", "split", "method", *header]
    return aligned(whole, lines, 3) if most is None else in_parts(whole, lines, 3, most)


ENERGIES = ("frames", "L_tot [J]", *(f"{name} [J]" for name in TERMS), "vertices inside the body [%]",
            "gravity excess over LBS [% m g L]", "L_tot of a clip, min / median / max [J]")  # fmt: skip
SHOWN_SKIN = ("covered points", "covered skin that shows [%]", "in the worst frame [%]", "clip", "time code",
              "where, share of what shows", "bare, mean / worst [%]")  # fmt: skip
INTERSECTIONS = ("frames counted", "triangles", "triangles that intersect others [%]", "in the worst frame [%]",
                 "clip", "time code", "where, share of what intersects")  # fmt: skip
MOTION = ("kinetic energy [J]", "RMS distance to static state [mm]", "RMS jerk [m/s3]", "RMS jerk / LBS",
          "larger principal stretch, 50 / 95 / 99 / 100 %")  # fmt: skip
REFERENCE = ("frames", "L_tot excess over simulator [J]", "simulator L_tot [J]",
             "gravity excess over simulator [% m g L]", "RMS position error [mm]", "RMS velocity error [m/s]",
             "RMS acceleration error [m/s2]", "RMS jerk / simulator")  # fmt: skip
SOLVER = ("windows", "lost", "energy of a step over its minimum [mJ]", "RMS distance to it [mm]",
          *(f"RMS distance after {count} frames [mm] (median)" for count in AFTER), "RMS velocity error [m/s]",
          "of LBS [m/s]")  # fmt: skip
SETTLING = ("stops", "kinetic energy at stop [J]", "kinetic energy at end [J]", "settled stops [%]",
            "median settling time [s]", "RMS distance to static state [mm]", "its maximum [mm]",
            "static energy excess over static state [J]", "gravity excess over static state [% m g L]")  # fmt: skip
MINIMUM = ("stops", "static energy excess over minimum [J]", "gravity excess over minimum [% m g L]",
           "LBS gravity excess over minimum [% m g L]", "RMS distance to minimum [mm]",
           "maximum static residual [g]")  # fmt: skip
LOOP_DRIFT = ("clips", "frames", "L_tot of second loop [J]", "L_tot of last loop [J]", "L_tot drift [J]",
              "largest L_tot drift [J]", "RMS distance between loops [mm]")  # fmt: skip
CLOSED_LOOP = ("states", "spectral radius of a step, median", "largest")
POSE_NOVELTY = ("distance to training poses, mean [deg]", "95th percentile [deg]", "L_tot, nearest half [J]",
                "L_tot, furthest tenth [J]")  # fmt: skip


def _energies(f: Figures) -> list[str]:
    terms = [f"{f.terms[name]:.4g}" for name in TERMS]
    spread = " / ".join(f"{value:.3g}" for value in f.clip_totals)
    return [str(f.frames), f"{f.total:.4g}", *terms, _percent(f.collisions), _signed(f.gravity_excess, 1), spread]


def _shown_skin(f: ShownSkin) -> list[str]:
    bare = " / ".join(_percent(share) for share in (f.bare, f.worst_bare))
    worst = (f.clip, f"{f.frame:g}") if f.worst else ("", "")
    return [str(f.covered), _percent(f.mean, 3), _percent(f.worst), *worst, f.where, bare]


def _intersections(f: SelfIntersections) -> list[str]:
    worst = (f.clip, f"{f.frame:g}") if f.worst else ("", "")
    return [str(f.frames), str(f.triangles), _percent(f.mean, 3), _percent(f.worst), *worst, f.where]


def _motion(f: Figures) -> list[str]:
    distance = "" if f.static_distance is None else _millimetres(f.static_distance)
    stretches = " / ".join(f"{value:.3f}" for value in f.stretch_quantiles)
    return [f"{f.kinetic_energy:.3g}", distance, f"{f.jerk:.3g}", f"{f.jerk_ratio:.2f}", stretches]


def _reference(f: ReferenceErrors) -> list[str]:
    return [str(f.frames), f"{f.total_excess:.4g}", f"{f.reference_total:.4g}", _signed(f.gravity_excess),
            _millimetres(f.position_error), f"{f.velocity_error:.3f}", f"{f.acceleration_error:.2f}",
            f"{f.jerk_ratio:.2f}"]  # fmt: skip


def _solver(f: SolverErrors) -> list[str]:
    each = zip(f.position_error, f.median_position_error)
    distances = [f"{_millimetres(rms)} ({_millimetres(median)})" for rms, median in each]
    return [str(f.windows), str(f.lost), f"{1000 * f.step_energy:.1f}", _millimetres(f.step_distance), *distances,
            f"{f.velocity_error:.3f}", f"{f.lbs_velocity_error:.3f}"]  # fmt: skip


def _settling(f: Settling) -> list[str]:
    time = f"{f.settling_time:.2f}" if isfinite(f.settling_time) else "never"
    return [str(f.stops), f"{f.initial_kinetic_energy:.2g}", f"{f.final_kinetic_energy:.2g}",
            _percent(f.settled_share, 0), time, _millimetres(f.static_distance), _millimetres(f.max_static_distance),
            f"{f.static_energy_excess:.4f}", _signed(f.gravity_excess)]  # fmt: skip


def _minimum(f: MinimumErrors) -> list[str]:
    return [str(f.stops), f"{f.static_energy_excess:.4f}", _signed(f.gravity_excess), _signed(f.lbs_gravity_excess),
            _millimetres(f.minimum_distance), f"{f.max_residual:.1g}"]  # fmt: skip


def _loop_drift(f: LoopDrift) -> list[str]:
    return [str(f.clips), str(f.frames), f"{f.second_loop_total:.4g}", f"{f.last_loop_total:.4g}",
            f"{f.total_drift:+.2g}", f"{f.max_total_drift:+.2g}", _millimetres(f.loop_distance)]  # fmt: skip


def _closed_loop(f: ClosedLoop) -> list[str]:
    return [str(f.states), f"{f.median_radius:.3f}", f"{f.max_radius:.3f}"]


def _pose_novelty(f: PoseNovelty) -> list[str]:
    angles = [f"{degrees(angle):.1f}" for angle in (f.mean_distance, f.p95_distance)]
    return [*angles, f"{f.nearest_half_total:.4g}", f"{f.furthest_tenth_total:.4g}"]


def _percent(share: float, digits: int = 2) -> str:
    return f"{100 * share:.{digits}f}"


def _signed(share: float, digits: int = 2) -> str:
    return f"{100 * share:+.{digits}f}"


def _millimetres(value: float) -> str:
    return f"{1000 * value:.1f}"


KINDS: tuple[tuple[Callable[[Figures], Any], Sequence[str], Callable[[Any], list[str]]], ...] = (
    (lambda figures: figures, ENERGIES, _energies),
    (lambda figures: figures.shown_skin, SHOWN_SKIN, _shown_skin),
    (lambda figures: figures.intersections, INTERSECTIONS, _intersections),
    (lambda figures: figures.reference, REFERENCE, _reference),
    (lambda figures: figures.solver, SOLVER, _solver),
    (lambda figures: figures, MOTION, _motion),
    (lambda figures: figures.settling, SETTLING, _settling),
    (lambda figures: figures.minimum, MINIMUM, _minimum),
    (lambda figures: figures.loop_drift, LOOP_DRIFT, _loop_drift),
    (lambda figures: figures.closed_loop, CLOSED_LOOP, _closed_loop),
    (lambda figures: figures.pose_novelty, POSE_NOVELTY, _pose_novelty),
)
