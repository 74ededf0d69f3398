# SPDX-License-Identifier: Apache-2.0
"""Totals of models that differ in one setting at a time."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from statistics import mean, mode
from typing import Any

from records import SETTINGS, Settings
from reports import RESULTS, table
from seeds import Cell, measured

from ssilk_core.charts import ChartPanel, write_chart
from ssilk_core.errors import fail
from ssilk_core.evaluation.splits import SPLITS

SWEEPS = {
    "table4": ("latent_regularization",),
    "table5": ("batch", "window", "latent"),
    "figure8": ("decoder",),
    "figure11": ("scheme",),
    "figure12": ("blendshapes", "proxies"),
}
Totals = dict[str, dict[Any, dict[str, list[float]]]]
"""Totals of all seeds [J] by setting, its value and the split."""


def swept(options: argparse.Namespace, told: Mapping[str, Settings]) -> dict[str, Settings]:
    """Return the settings of the models, by name.

    Raises:
        SsilkError: models of several garments, or baselines.
    """
    odd = next((name for name, settings in told.items() if "baseline" in settings), "")
    if odd:
        fail(options.table, f"{odd} is a baseline", "all are models of 'ssilk train'")
    garments = {settings["garment"] for settings in told.values()}
    if len(garments) != 1:
        fail(options.table, f"models of {', '.join(sorted(garments))}", "all are of one garment")
    return {model: {name: settings[name] for name in SETTINGS} for model, settings in told.items()}


def alone(told: Mapping[str, Settings], name: str) -> dict[Any, list[str]]:
    """Return the models by the value of one setting, those whose other settings are what most models have."""
    if name == "decoder":
        return _decoders(told)
    others = [other for other in next(iter(told.values())) if other != name]
    usual = {other: mode(settings[other] for settings in told.values()) for other in others}
    found: dict[Any, list[str]] = {}
    for model, settings in told.items():
        if all(settings[other] == usual[other] for other in others):
            found.setdefault(settings[name], []).append(model)
    return dict(sorted(found.items()))


def _decoders(told: Mapping[str, Settings]) -> dict[str, list[str]]:
    shapes, proxies = alone(told, "blendshapes"), alone(told, "proxies")
    usual = set(chain(*shapes.values())) & set(chain(*proxies.values()))
    both = [model for model in told if model in usual]
    return {"joints alone": shapes.get(0, []), "blendshapes alone": proxies.get(0, []), "both": both}


def sweep(options: argparse.Namespace) -> tuple[str, Any]:
    """Return totals by setting, one changed at a time."""
    rows, models = measured(options)
    told = swept(options, models)
    lines, found = [], Totals()
    for name in SWEEPS[options.table]:
        for value, names in alone(told, name).items():
            own = [row for row in rows if row["model"] and Path(row["model"]).stem in names]
            totals = {split: Cell([row for row in own if row["split"] == split]) for split in SPLITS}
            lines.append([name, str(value), len(names), *(cell.shown(["total"]) for cell in totals.values())])
            found.setdefault(name, {})[value] = {split: cell.values(["total"]) for split, cell in totals.items()}
    draw_sweep(options, found)
    return table(("setting", "value", "models", *(f"{split} [J]" for split in SPLITS)), lines), found


def draw_sweep(options: argparse.Namespace, found: Totals) -> None:
    """Draw mean totals over each setting that is a number with several values, a curve for each split."""
    several = {name: values for name, values in found.items() if len(values) > 1 and not isinstance(min(values), str)}
    if not several:
        return
    panels = []
    for name, values in several.items():
        kept = {split: [value for value, of in values.items() if of[split]] for split in SPLITS}
        curves = {split: (xs, [mean(values[x][split]) for x in xs]) for split, xs in kept.items()}
        heights = [height for _, ys in curves.values() for height in ys]
        span = min(0.0, *heights), 1.05 * max(heights)
        panels.append(ChartPanel(x=name, y="L_tot [J]", curves=curves, span=span))
    write_chart(RESULTS / f"{options.name}.png", [panels], size=(4.0, 2.8))
