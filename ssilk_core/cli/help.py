# SPDX-License-Identifier: Apache-2.0
"""Say what all verbs, or one of them, are for."""

from __future__ import annotations

import argparse

from ..errors import EXIT_OK
from ..events import Reporter


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    from . import VERBS, name_of

    verbs = [name_of(module) for module in VERBS]
    verb.add_argument("about", nargs="?", choices=verbs, metavar="VERB", help="what to explain (default: all)")


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Print the help; return 0."""
    from . import parser

    parser().parse_args([*filter(None, [options.about]), "--help"])
    return EXIT_OK
