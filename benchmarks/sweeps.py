# SPDX-License-Identifier: Apache-2.0
"""Totals of models that differ in one setting at a time."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from statistics import mean, mode
from typing import Any

from plots import COLOURS, Panel, canvas, save
from reports import RESULTS, table
from seeds import Cell, evaluated

from ssilk_core.baselines.files import KEY, load_network
from ssilk_core.checkpoint import ModelFile
from ssilk_core.errors import need
from ssilk_core.evaluation.splits import SPLITS

Setting = Callable[[ModelFile], Any]
SETTINGS: dict[str, Setting] = {
    "batch": lambda file: file.provenance["train"]["batch"],
    "window": lambda file: file.provenance["train"]["window"],
    "latent": lambda file: file.config.latent,
    "blendshapes": lambda file: file.config.shapes,
    "proxies": lambda file: file.scene.rig.proxy_count,
    "scheme": lambda file: file.config.scheme,
    "decoder": lambda file: _decoder(file.config.shapes, file.scene.rig.proxy_count),
}
SWEEPS = {
    "table5": ("batch", "window", "latent"),
    "figure8": ("decoder",),
    "figure12": ("blendshapes", "proxies"),
}
Totals = dict[str, dict[Any, dict[str, list[float]]]]
"""Totals of all seeds [J] by setting, its value and the split."""


def _decoder(shapes: int, proxies: int) -> str:
    return "both" if shapes and proxies else "blendshapes alone" if shapes else "joints alone"


def told_by(options: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """Return the settings of each model, by its path.

    Raises:
        SsilkError: models of several garments, or baselines.
    """
    files = {str(path): load_network(path)[0] for path in options.models}
    odd = next((path for path, file in files.items() if KEY in file.provenance), "")
    need(not odd, options.table, f"{odd} is a baseline", "all are models of 'ssilk train'")
    garments = {file.scene.garment.mesh.path.rpartition("/")[2] for file in files.values()}
    need(len(garments) == 1, options.table, f"models of {', '.join(sorted(garments))}", "all are of one garment")
    names = SWEEPS[options.table]
    return {path: {name: SETTINGS[name](file) for name in names} for path, file in files.items()}


def alone(told: Mapping[str, Mapping[str, Any]], name: str) -> dict[Any, list[str]]:
    """Return the models by the value of one setting, those whose other settings are what most models have."""
    others = [other for other in next(iter(told.values())) if other != name]
    usual = {other: mode(settings[other] for settings in told.values()) for other in others}
    found: dict[Any, list[str]] = {}
    for path, settings in told.items():
        if all(settings[other] == usual[other] for other in others):
            found.setdefault(settings[name], []).append(path)
    return dict(sorted(found.items()))


def sweep(options: argparse.Namespace) -> tuple[str, Any]:
    """Return totals by setting, one changed at a time."""
    told, (rows, _) = told_by(options), evaluated(options)
    lines, found = [], Totals()
    for name in SWEEPS[options.table]:
        for value, paths in alone(told, name).items():
            own = [row for row in rows if row["model"] in paths]
            totals = {split: Cell([row for row in own if row["split"] == split]) for split in SPLITS}
            lines.append([name, str(value), *(cell.shown(["total"]) for cell in totals.values())])
            found.setdefault(name, {})[value] = {split: cell.values(["total"]) for split, cell in totals.items()}
    draw_sweep(options, found)
    return table(("setting", "value", *(f"{split} [J]" for split in SPLITS)), lines), found


def draw_sweep(options: argparse.Namespace, found: Totals) -> None:
    """Draw mean totals over each setting that is a number with several values, a curve for each split."""
    swept = {name: values for name, values in found.items() if len(values) > 1 and not isinstance(min(values), str)}
    if not swept:
        return
    image, pen = canvas(440 * len(swept), 300)
    for place, (name, values) in enumerate(swept.items()):
        curves = {split: [(x, mean(of[split])) for x, of in values.items() if of[split]] for split in SPLITS}
        heights = [y for points in curves.values() for _, y in points]
        box = (440 * place + 60, 40, 440 * place + 420, 250)
        panel = Panel(pen, box, (min(values), max(values)), (min(0.0, *heights), max(heights)))
        panel.title(f"L_tot [J] over {name}")
        panel.grid()
        for number, (split, points) in enumerate(curves.items()):
            panel.curve(points, COLOURS[number])
            pen.text((440 * place + 60 + 100 * number, 278), split, fill=COLOURS[number])
    save(image, RESULTS / f"{options.name}.png")
