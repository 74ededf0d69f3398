# SPDX-License-Identifier: Apache-2.0
"""Tables of measurements to print, and result files with the command and the hardware behind the figures."""

from __future__ import annotations

import argparse
import json
import os
import platform
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from ssilk_core import __version__
from ssilk_core.devices import device_name, select_device
from ssilk_core.files import replacing

RESULTS = Path(__file__).parents[1] / "results"
WIDTH = 110  # of a line in a result file, but for rows and lists of numbers


def table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return a Markdown table, its first column to the left and the others to the right."""
    lines = [header, ["---", *["---:"] * (len(header) - 1)], *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines) + "\n"


def write_results(options: argparse.Namespace, markdown: str, measured: Mapping[str, Any]) -> None:
    """Print tables, and write the figures that they came from as `save_results` does."""
    print(markdown)
    save_results(options, measured)


def save_results(options: argparse.Namespace, measured: Mapping[str, Any]) -> None:
    """Write figures to a result file with their `provenance`."""
    write_document(RESULTS / f"{options.name}.json", provenance(options), measured)


def provenance(options: argparse.Namespace) -> dict[str, str]:
    """Return command, hardware and versions; the hardware is `options.device`'s where none is named."""
    return {
        "command": "python benchmarks/" + shlex.join(map(_without_folders, sys.argv)),
        "hardware": getattr(options, "hardware", None) or _hardware(options),
        "versions": f"ssilk {__version__}, torch {torch.__version__}, Python {platform.python_version()}",
    }


def write_document(path: Path, source: Mapping[str, str], measured: Mapping[str, Any]) -> None:
    """Write figures with where they come from."""
    with replacing(path) as temporary:
        temporary.write_text(indented({**source, "measured": rounded(measured)}) + "\n")


def _without_folders(word: str) -> str:
    """Return "name=file" from "name=folder/file"."""
    name, mark, path = word.rpartition("=")
    return name + mark + Path(path).name if "/" in path else word


def rounded(value: Any) -> Any:
    """Return a JSON document with its numbers rounded to six significant digits."""
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, Mapping):
        return {key: rounded(item) for key, item in value.items()}
    return [rounded(item) for item in value] if isinstance(value, (list, tuple)) else value


def indented(value: Any, depth: int = 1) -> str:
    """Return JSON with a line for what fits into one, for each list of numbers, and for each row of a list."""
    flat = json.dumps(value)
    if len(flat) <= WIDTH or (_levels(value) < 2 and not isinstance(value, dict)):
        return flat
    if isinstance(value, dict):
        lines, ends = [f"{json.dumps(str(name))}: {indented(item, depth + 1)}" for name, item in value.items()], "{}"
    else:
        lines = [json.dumps(item) if _levels(item) <= 2 else indented(item, depth + 1) for item in value]
        ends = "[]"
    within = ",\n".join(" " * depth + line for line in lines)
    return f"{ends[0]}\n{within}\n{' ' * (depth - 1)}{ends[1]}"


def _levels(value: Any) -> int:
    """Return how deep lists and objects are nested; 0 for a number or text."""
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, list) else None
    return 0 if parts is None else 1 + max(map(_levels, parts), default=0)


def _hardware(options: argparse.Namespace) -> str:
    """Return the device, the cores and how busy they were in the last quarter of an hour."""
    device, load = device_name(select_device(options.device)), os.getloadavg()[2]
    return f"{device}, {options.threads} of {os.cpu_count()} cores, load {load:.1f}"
