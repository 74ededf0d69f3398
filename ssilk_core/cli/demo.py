# SPDX-License-Identifier: Apache-2.0
"""Dress the demo body, train a cape as a draft, bake it, verify it, and show it beside plain skinning."""

from __future__ import annotations

import argparse
from pathlib import Path

from ssilk_core.events import Reporter


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    verb.add_argument(
        "--out", type=Path, default=Path("demo_out"), help="folder for everything the demo makes (default demo_out)"
    )


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Run the demo."""
    raise NotImplementedError
