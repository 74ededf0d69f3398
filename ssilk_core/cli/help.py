# SPDX-License-Identifier: Apache-2.0
"""Say what all verbs, or one of them, are for."""

from __future__ import annotations

import argparse

from ..errors import EXIT_OK
from ..events import Reporter


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    verb.add_argument("about", nargs="?", metavar="VERB", help="what to explain (default: all)")


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Print the help; return 0."""
    options.parser.parse_args([*filter(None, [options.about]), "--help"])
    return EXIT_OK
