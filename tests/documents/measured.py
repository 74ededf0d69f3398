# SPDX-License-Identifier: Apache-2.0
"""What `benchmarks/results` and the shipped models hold, and the forms that documents show it in."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial, reduce
from math import floor, log10
from operator import getitem
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from safetensors import safe_open

from ssilk_core.network.settings import ModelConfig
from ssilk_core.training.settings import TrainConfig

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results"
GARMENTS = {
    "Cape": "cape",
    "HoodedDress": "hooded dress",
    "FringeSkirt": "fringe skirt",
    "tshirt": "T-shirt",
    "long_sleeve": "long sleeve",
    "pants": "pants",
}
METHODS = {"LBS": "LBS", "ncs": "NCS", "ncs*": "NCS*", "snug": "SNUG", "ssilk": "SSILK"}
SPLITS = ("valid", "inertia", "flips")

read: set[str] = set()  # names of the files that `document` has read


@cache
def document(name: str) -> dict[str, Any]:
    """Return a file of results."""
    read.add(name)
    return json.loads((RESULTS / f"{name}.json").read_text())


def result(name: str) -> Any:
    """Return what a benchmark measured."""
    return document(name)["measured"]


@cache
def cells(name: str) -> dict[tuple[str, str, str], dict[str, list[float]]]:
    """Return the figures of all seeds of a comparison, by garment, method and split."""
    return {(row["garment"], row["method"], row["split"]): row for row in result(name)["figures"]}


def means(name: str, figure: str) -> dict[tuple[str, str, str], float]:
    """Return the means over seeds of one figure of a comparison, by garment, method and split."""
    return {key: mean(cell[figure]) for key, cell in cells(name).items() if figure in cell}


@cache
def evaluated(model: str) -> dict[str, dict[str, Any]]:
    """Return the figures of `ssilk evaluate` for a model, by split."""
    rows = document(f"evaluate_{model}")["figures"]
    return {row["split"]: row["figures"] for row in rows if row["method"] == "ssilk"}


@cache
def shipped(model: str) -> dict[str, Any]:
    """Return what the file of a shipped model says about itself, and its number of vertices."""
    with safe_open(ROOT / "ssilk_core" / "demo" / "models" / f"{model}.safetensors", "np") as file:
        (vertices,) = file.get_slice("scene.classes").get_shape()
        return {**json.loads(file.metadata()["ssilk"]), "vertices": vertices}


def default(setting: str) -> Any:
    """Return the default of a setting of the model or of its training."""
    config = ModelConfig() if hasattr(ModelConfig, setting) else TrainConfig()
    return getattr(config, setting)


Form = Callable[[Any], str]


def digits(value: float, count: int = 3) -> str:
    """Return a number with so many significant digits, without an exponent: 0.0200, 16.4, 1,230."""
    if not value:
        return "0"
    rounded = float(f"{value:.{count}g}")
    places = 0 if abs(rounded) >= 10 ** (count - 1) else count - 1 - floor(log10(abs(rounded)))
    return signed(f"{rounded:,.{places}f}")


def fixed(values: Sequence[float] | float, places: int = 0, unit: float = 1) -> str:
    """Return a number, or the mean of several, in a unit and with so many decimal places."""
    value = mean(values) if isinstance(values, Sequence) else values
    return signed(f"{value / unit:,.{places}f}")


percent = partial(fixed, unit=0.01)
milli = partial(fixed, unit=1e-3)  # millimetres, milliseconds
micro = partial(fixed, unit=1e-6)


def signed(text: str) -> str:
    """Return a formatted number with a minus sign in place of a hyphen, and a zero without either."""
    return text.replace("-", "−") if re.search("[1-9]", text) else text.lstrip("-")


def spread(values: Sequence[float], count: int = 3) -> str:
    """Return the mean, with the standard deviation where there are several seeds."""
    return digits(mean(values), count) + (f" ± {stdev(values):.1g}" if len(values) > 1 else "")


def duration(seconds: float) -> str:
    """Return a time as 25 s or 4 min 03 s."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{rest} s"


def row(*values: object) -> str:
    """Return a row of a Markdown table."""
    return f"| {' | '.join(map(str, values))} |"


def fields(source: Mapping[str, Any], forms: Mapping[str, Form]) -> list[str]:
    """Return values of nested results as text; `forms` has the form of each by its path: "settling/stops"."""
    return [form(reduce(getitem, path.split("/"), source)) for path, form in forms.items()]


def series(values: Iterable[object]) -> str:
    return ", ".join(map(str, values))
