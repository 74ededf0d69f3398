# SPDX-License-Identifier: Apache-2.0
"""Records: figures of models with the models' settings, measured on one machine and tabled on another."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from baselines.files import KEY, load_network

from ssilk_core.devices import device_name, select_device
from ssilk_core.errors import fail
from ssilk_core.files import replacing
from ssilk_core.network.checkpoint import ModelFile
from ssilk_core.training.curve import curve_path

Row = dict[str, Any]
Settings = dict[str, Any]

SETTINGS: dict[str, Callable[[ModelFile], Any]] = {
    "batch": lambda file: file.provenance["train"]["batch"],
    "window": lambda file: file.provenance["train"]["window"],
    "latent": lambda file: file.config.latent,
    "blendshapes": lambda file: file.config.shapes,
    "proxies": lambda file: file.scene.rig.proxy_count,
    "scheme": lambda file: file.config.scheme,
    "latent_regularization": lambda file: file.provenance["train"].get("latent_regularization", 0.0),
}


def settings_of(path: Path) -> Settings:
    """Return what a model was trained with, and how long: of a baseline its method alone is a setting."""
    file, _ = load_network(path)
    told = file.provenance
    found = {"baseline": told[KEY]["method"]} if KEY in told else {name: of(file) for name, of in SETTINGS.items()}
    curve = curve_path(path)
    points = json.loads(curve.read_text())["points"] if curve.is_file() else []
    trained = {
        "seed": told["train"].get("seed"),
        "iterations": points[-1]["iteration"] if points else told["train"].get("iterations"),
        "seconds": points[-1]["seconds"] if points else None,
    }
    garment = file.scene.garment.mesh.path.rpartition("/")[2]
    return {"garment": garment, **found, "trained": trained}


def write_record(options: argparse.Namespace, rows: Sequence[Row]) -> None:
    """Write rows with the settings of their models, by the models' names."""
    document = {
        "hardware": device_name(select_device(options.device)),
        "sequence": options.sequence,
        "models": {path.stem: settings_of(path) for path in options.models},
        "rows": rows,
    }
    with replacing(options.output) as temporary:
        temporary.write_text(json.dumps(document, indent=1) + "\n")


def read_records(paths: Sequence[Path]) -> tuple[list[Row], dict[str, Settings], str]:
    """Return the rows of records, each with its "sequence", the settings of all models by name, and the hardware.

    Raises:
        SsilkError: a file is no record.
    """
    rows: list[Row] = []
    models: dict[str, Settings] = {}
    hardware: dict[str, None] = {}
    for path in paths:
        try:
            document = json.loads(path.read_text())
            rows += [{**row, "sequence": document["sequence"]} for row in document["rows"]]
            models |= document["models"]
            hardware[document["hardware"]] = None
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            fail(str(path), f"no record ({type(error).__name__}: {error})", "'tables.py record' writes them")
    if not rows:
        fail(", ".join(map(str, paths)), "no figures in these records", "'tables.py record' writes them")
    return rows, models, ", ".join(hardware)


def with_reference(rows: Sequence[Row]) -> list[Row]:
    """Return the rows of whole clips, where there are any, with the errors that sequences have to the simulator."""
    errors = {_key(row): row["figures"]["reference"] for row in rows if row["figures"]["reference"]}
    whole = [row for row in rows if row["sequence"] is None] or rows
    return [{**row, "figures": {**row["figures"], "reference": errors.get(_key(row))}} for row in whole]


def _key(row: Row) -> tuple[str, ...]:
    return Path(row["model"] or "").stem, row["garment"], row["method"].partition(" (")[0], row["split"]
