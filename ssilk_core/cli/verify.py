# SPDX-License-Identifier: Apache-2.0
"""Check a baked shot and compare it, re-skinned by UsdSkel alone, with the decoder's own vertices.

The shot says which model, stage and motion it came from; name them anew where they have moved.
"""

from __future__ import annotations

import argparse
from dataclasses import fields, replace
from pathlib import Path

from ssilk_core.errors import EXIT_OK, need
from ssilk_core.events import Reporter, Result, Started


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    verb.add_argument("shot", type=Path, help="shot written by 'ssilk bake'")
    verb.add_argument("--model", help="where the model lies now")
    verb.add_argument("--stage", help="where the character's stage lies now")
    verb.add_argument("--motion", help="where the motion lies now")


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Verify; raise `VerificationError` (exit code 3) when the file is not what was computed."""
    from ssilk_usd.provenance import read_provenance

    from ._baking import BakeRequest, open_bake

    need(
        options.shot.is_file(), str(options.shot), "there is no such shot", "a file written by 'ssilk bake' is needed"
    )
    carried = read_provenance(options.shot).get("request")
    carried = carried if isinstance(carried, dict) else {}
    need(
        carried,
        str(options.shot),
        "the file does not say how it was baked",
        "a shot written by 'ssilk bake' is needed",
    )
    known = {item.name for item in fields(BakeRequest)}
    request = BakeRequest(**{key: value for key, value in carried.items() if key in known})
    moved = {key: getattr(options, key) for key in ("model", "stage", "motion") if getattr(options, key)}
    bake = open_bake(replace(request, **moved))
    report(Started("verify", bake.motion.frame_count, {"shot": str(options.shot)}))
    report(Result("verify", {"shot": str(options.shot), **bake.verify(options.shot, report)}))
    return EXIT_OK
