# SPDX-License-Identifier: Apache-2.0
"""Tables of measurements, and the files that they go to with the command and the hardware behind them."""

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
from ssilk_core.devices import chosen_device, device_name
from ssilk_core.files import replacing

RESULTS = Path(__file__).parent / "results"


def table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Return a Markdown table, its first column to the left and the others to the right."""
    lines = [header, ["---", *["---:"] * (len(header) - 1)], *rows]
    return "\n".join("| " + " | ".join(map(str, line)) + " |" for line in lines) + "\n"


def write_results(options: argparse.Namespace, markdown: str, measured: Mapping[str, Any]) -> None:
    """Print tables and write them, with command and hardware, beside the figures they came from."""
    print(markdown)
    save_results(options, markdown, measured)


def save_results(options: argparse.Namespace, markdown: str, measured: Mapping[str, Any]) -> None:
    """Write what `write_results` does and print nothing; the hardware is `options.device`'s where none is named."""
    command = "python benchmarks/" + shlex.join([Path(word).name if "/" in word else word for word in sys.argv])
    made = {
        "command": command,
        "hardware": getattr(options, "hardware", None) or _hardware(options),
        "versions": f"ssilk {__version__}, torch {torch.__version__}, Python {platform.python_version()}",
    }
    with replacing(RESULTS / f"{options.name}.json") as temporary:
        temporary.write_text(json.dumps({**made, "measured": measured}, indent=1) + "\n")
    foot = f"\n`{command}`  \n{made['hardware']}; {made['versions']}\n"
    with replacing(RESULTS / f"{options.name}.md") as temporary:
        temporary.write_text(markdown + foot)


def _hardware(options: argparse.Namespace) -> str:
    return f"{device_name(chosen_device(options.device))}, {options.threads} of {os.cpu_count()} cores"
