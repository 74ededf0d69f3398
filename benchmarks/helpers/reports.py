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
WIDTH = 110  # of a line in a result file


def table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return a Markdown table, its first column to the left and the others to the right."""
    lines = [header, ["---", *["---:"] * (len(header) - 1)], *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines) + "\n"


def write_results(options: argparse.Namespace, markdown: str, measured: Mapping[str, Any]) -> None:
    """Print tables, and write the figures that they came from as `save_results` does."""
    print(markdown)
    save_results(options, measured)


def save_results(options: argparse.Namespace, measured: Mapping[str, Any]) -> None:
    """Write figures with command, hardware and versions; the hardware is `options.device`'s where none is named."""
    command = "python benchmarks/" + shlex.join([Path(word).name if "/" in word else word for word in sys.argv])
    document = {
        "command": command,
        "hardware": getattr(options, "hardware", None) or _hardware(options),
        "versions": f"ssilk {__version__}, torch {torch.__version__}, Python {platform.python_version()}",
        "measured": rounded(measured),
    }
    with replacing(RESULTS / f"{options.name}.json") as temporary:
        temporary.write_text(indented(document) + "\n")


def rounded(value: Any) -> Any:
    """Return a JSON document with its numbers rounded to six significant digits."""
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, Mapping):
        return {key: rounded(item) for key, item in value.items()}
    return [rounded(item) for item in value] if isinstance(value, (list, tuple)) else value


def indented(value: Any, depth: int = 1) -> str:
    """Return JSON in which what fits into a line stands on one."""
    flat = json.dumps(value)
    if len(flat) <= WIDTH or not isinstance(value, (dict, list)):
        return flat
    named = isinstance(value, dict)
    items = value.items() if isinstance(value, dict) else (("", item) for item in value)
    lines = [(f"{json.dumps(str(name))}: " if named else "") + indented(item, depth + 1) for name, item in items]
    within = ",\n".join(" " * depth + line for line in lines)
    return f"{'{' if named else '['}\n{within}\n{' ' * (depth - 1)}{'}' if named else ']'}"


def _hardware(options: argparse.Namespace) -> str:
    return f"{device_name(select_device(options.device))}, {options.threads} of {os.cpu_count()} cores"
