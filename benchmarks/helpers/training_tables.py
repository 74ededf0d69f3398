# SPDX-License-Identifier: Apache-2.0
"""The figures of `training.py` as Markdown: the base case part by part, and how times grow."""

from __future__ import annotations

from typing import Any

from .clock import Rates
from .floors import WARM, WINDOWS, Floor
from .reports import table

Figures = dict[str, Any]


def tables(measured: Figures) -> str:
    """Return all tables of what was measured so far."""
    rates, every = Rates(**measured["rates"]), measured["cases"]
    said = (
        f"A copy moves {rates.copy / 1e9:.4g} GB/s here, a float32 matrix product does {rates.product / 1e12:.3g} "
        f"TFLOP/s. The base case: {', '.join(f'{name} {count}' for name, count in every['base']['size'].items())}.\n"
    )
    if measured["triton"]:
        said = f"Kernels are compiled by Triton {measured['triton']}. {said}"
    return "\n".join([said, base_table(every["base"], rates), growth_table(every)])


def variants(case: Figures) -> list[str]:
    """Return the variants that were measured; training runs the last."""
    return [name for name in case if name != "size"]


def base_table(case: Figures, rates: Rates) -> str:
    """Return a line for each part and each whole step: all variants, the floor, and how far that is."""
    names = variants(case)
    header = ["", *(f"{name} [ms]" for name in names), "10 % to 90 % [ms]", *["faster by"] * (len(names) > 1)]
    rows = []
    for part, figures in case[names[-1]]["parts"].items():
        floor = Floor(**figures["floor"])
        rows.append([part, *_line([case[name]["parts"][part] for name in names], floor.time(rates))])
    for phase in (WARM, WINDOWS):
        floors = [Floor(**figures["floor"]).time(rates) for figures in _parts(case[names[-1]], phase)]
        rows.append([f"step of {phase}", *_line([case[name]["steps"][phase] for name in names], sum(floors))])
    return table([*header, "floor [ms]", "over the floor"], rows)


def _line(spans: list[Figures], floor: float) -> list[str]:
    medians = [span["median"] for span in spans]
    spread = f"{spans[-1]['low']:.3g} to {spans[-1]['high']:.3g}"
    gain = [f"{medians[0] / medians[-1]:.1f}x"] * (len(spans) > 1)
    return [*(f"{value:.3g}" for value in medians), spread, *gain, f"{floor:.2g}", f"{medians[-1] / floor:.1f}x"]


def _parts(figures: Figures, phase: str) -> list[Figures]:
    """Return the parts of a phase, each once."""
    return [part for part in figures["parts"].values() if phase in part["phases"]]


def growth_table(every: dict[str, Figures]) -> str:
    """Return a line for each part of a phase, for each step and for peak memory, and a column for each case."""
    names = variants(every["base"])
    runs = [case[names[-1]] for case in every.values()]
    counted = [name for name, part in runs[0]["parts"].items() if part["phases"]]
    rows = [[name, *(f"{run['parts'][name]['median']:.3g}" for run in runs)] for name in counted]
    for phase in (WARM, WINDOWS):
        sums = [sum(part["median"] for part in _parts(run, phase)) for run in runs]
        rows.append([f"parts of {phase}", *(f"{value:.3g}" for value in sums)])
        for name in names:
            times = (case[name]["steps"][phase]["median"] for case in every.values())
            rows.append([f"step of {phase}, {name}", *(f"{time:.3g}" for time in times)])
    for name in names if runs[0]["peak"] else ():
        rows.append([f"peak memory, {name} [MiB]", *(str(case[name]["peak"] >> 20) for case in every.values())])
    return table([f"{names[-1]} [ms]", *every], rows)
