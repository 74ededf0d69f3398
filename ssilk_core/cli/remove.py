# SPDX-License-Identifier: Apache-2.0
"""Take garments out of the shots of a folder of layers, and write the stages of these shots again.

The garment's layers in the shot are removed. Its asset stays, for other shots. The name of a garment that is in no
shot any more is free for another model.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ..errors import EXIT_OK
from ..events import Reporter, Result


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    verb.add_argument("folder", type=Path, help="folder of layers written by 'ssilk bake'")
    verb.add_argument("names", nargs="+", metavar="SHOT/GARMENT",
                      help="what to take out, such as walk/cape; or a pattern, such as '*/cape'")  # fmt: skip


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Remove."""
    from ..delivery.bake.shots import remove_layers

    removed = remove_layers(options.folder, options.names, report)
    report(Result("remove", {"removed": removed, "output": str(options.folder)}))
    return EXIT_OK
