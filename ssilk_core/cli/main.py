# SPDX-License-Identifier: Apache-2.0
"""The command itself: its verbs, how its words are parsed, and what becomes of an error."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from types import ModuleType

from .. import __version__
from ..errors import EXIT_BAD_INPUT, EXIT_INTERRUPTED, SsilkError
from ..events import Failed, JsonReporter, Reporter, TextReporter
from . import (
    bake,
    completion,
    demo,
    evaluate,
    export,
    farm,
    help,
    inspect,
    reduce,
    remove,
    report,
    rig,
    simulate,
    skin,
    stress,
    task,
    trade,
    train,
    verify,
    view,
    wardrobe,
)
from .parsing import Parser

VERBS = (
    inspect,
    rig,
    train,
    wardrobe,
    reduce,
    export,
    bake,
    remove,
    simulate,
    skin,
    evaluate,
    trade,
    stress,
    report,
    verify,
    view,
    farm,
    task,
    demo,
    completion,
    help,
)

# The extra of the distribution that installs everything a verb needs; "all" for others.
EXTRAS = {
    "inspect": "train",
    "rig": "setup",
    "train": "train",
    "wardrobe": "train",
    "reduce": "usd",
    "export": "export",
    "bake": "bake",
    "remove": "usd",
    "simulate": "train",
    "skin": "train",
    "evaluate": "train",
    "trade": "report",
    "stress": "train",
    "report": "report",
    "verify": "bake",
    "view": "view",
    "farm": "farm",
    "task": "bake",
}
OPTIONAL = ("torch", "pxr", "igl", "scipy", "trimesh", "embreex", "imageio_ffmpeg", "PIL", "matplotlib", "ray",
            "onnxscript")  # fmt: skip


def name_of(module: ModuleType) -> str:
    """Return the verb that a module is about."""
    return module.__name__.rpartition(".")[2]


def parser() -> Parser:
    """Return the parser of all verbs."""
    top = Parser(prog="ssilk", description="Neural loose garments, trained by physics alone, baked as UsdSkel.")
    top.add_argument("--version", action="version", version=f"ssilk {__version__}")
    verbs = top.add_subparsers(dest="verb", metavar="VERB", required=True)
    for module in VERBS:
        verb = verbs.add_parser(
            name_of(module),
            help=(module.__doc__ or "").splitlines()[0],
            description=module.__doc__,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        verb.add_argument(
            "--json", action="store_true", help="events as JSON, one object per line, on standard output"
        )
        # A verb that runs or explains others gets both: importing them from here would be a circle.
        verb.set_defaults(run=module.run, main=main, parser=top)
        module.add_arguments(verb)
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return its exit code: 0, 2 bad input, 3 not verified, 4 tasks failed, 130 interrupted."""
    words = sys.argv[1:] if arguments is None else list(arguments)
    report: Reporter = JsonReporter() if "--json" in words else TextReporter()
    try:
        options = parser().parse_args(words)
        return int(options.run(options, report))
    except SsilkError as error:
        report(Failed(str(error)))
        return error.exit_code
    except KeyboardInterrupt:
        report(Failed("interrupted; nothing half written was left behind."))
        return EXIT_INTERRUPTED
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in OPTIONAL:
            raise
        extra = EXTRAS.get(options.verb, "all")
        report(
            Failed(f"'{options.verb}' needs {error.name}, which is not installed; install the extra ssilk[{extra}].")
        )
        return EXIT_BAD_INPUT
    except OSError as error:
        report(Failed(f"{error.filename or options.verb}: {error.strerror or error}; check the path and its disk."))
        return EXIT_BAD_INPUT
