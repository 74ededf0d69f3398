# SPDX-License-Identifier: Apache-2.0
"""Ablations: totals of models that differ in one setting at a time."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from statistics import mean, mode
from typing import Any

from ssilk_core.errors import fail
from ssilk_core.quality.evaluation.splits import SPLITS

from .records import SETTINGS, Settings
from .reports import table
from .seeds import Cell, measured

ABLATIONS = ("decoder", "scheme", "blendshapes", "proxies", "latent_regularization", "batch", "window", "latent")
"""Settings of the paper's Figures 8, 11 and 12 and its Tables 4 and 5."""


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


def alone(told: Mapping[str, Settings], name: str) -> Mapping[Any, list[str]]:
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
    found = {"joints alone": shapes.get(0, []), "blendshapes alone": proxies.get(0, []), "both": both}
    return {name: models for name, models in found.items() if models}


def ablations(options: argparse.Namespace) -> tuple[str, Any]:
    """Return totals by setting, one changed at a time."""
    rows, models = measured(options)
    told = swept(options, models)
    found: list[dict[str, Any]] = []
    for name in ABLATIONS:
        values = alone(told, name)
        for value, names in values.items() if len(values) > 1 else ():
            own = [row for row in rows if row["model"] and Path(row["model"]).stem in names]
            totals = {
                split: Cell([row for row in own if row["split"] == split]).values(["total"]) for split in SPLITS
            }
            found.append({"setting": name, "value": str(value), **{s: each for s, each in totals.items() if each}})
    splits = [split for split in SPLITS if any(split in row for row in found)]
    lines = [
        [row["setting"], row["value"], *(f"{mean(row[s]):.4g}" if s in row else "" for s in splits)] for row in found
    ]
    (garment,) = {settings["garment"] for settings in models.values()}
    iterations = mode(settings["trained"]["iterations"] for settings in models.values())
    text = table(("setting", "value", *(f"{split}: L_tot [J]" for split in splits)), lines)
    return text, {"garment": garment, "iterations": iterations, "total": found}
