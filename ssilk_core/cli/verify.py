# SPDX-License-Identifier: Apache-2.0
"""Check a baked shot and compare it, re-skinned by UsdSkel alone, with the decoder's own vertices.

The shot says which model, stage and motion it came from; name them anew where they have moved.
"""

from __future__ import annotations

import argparse
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

from ..errors import EXIT_OK, fail
from ..events import Message, Reporter, Result, Started
from .options import INPUTS


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    verb.add_argument("shot", type=Path, help="shot written by 'ssilk bake'")
    for name in INPUTS:
        verb.add_argument(f"--{name}", metavar="PATH", help=f"where the {name} lies now")
    verb.add_argument("--device", help="where the network runs (default: where it ran for the bake)")


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Verify; raise `VerificationError` (exit code 3) when the file is not what was computed."""
    from ssilk_usd.provenance import read_provenance

    from ._baking import BakeRequest, open_bake

    if not options.shot.is_file():
        fail(str(options.shot), "there is no such shot", "a file written by 'ssilk bake' is needed")
    provenance = read_provenance(options.shot)
    carried: Any = provenance.get("request")
    if not (isinstance(carried, dict) and set(INPUTS) <= carried.keys()):
        fail(str(options.shot), "the file does not say how it was baked", "a shot written by 'ssilk bake' is needed")
    known = {item.name for item in fields(BakeRequest)}
    request = BakeRequest(**{key: value for key, value in carried.items() if key in known})
    chosen = {name: getattr(options, name) or _found(options.shot, name, provenance) for name in INPUTS}
    bake = open_bake(replace(request, **chosen, device=options.device or request.device))  # type: ignore[arg-type]
    for name in ("model", "motion"):
        if provenance.get(f"{name}_sha256") != bake.provenance[f"{name}_sha256"]:
            report(Message(f"{chosen[name]}: the {name} has changed since the shot was baked from it", "warning"))
    report(Started("verify", bake.motion.frame_count, {"shot": str(options.shot)}))
    report(Result("verify", {"shot": str(options.shot), **bake.verify(options.shot, report)}))
    return EXIT_OK


def _found(shot: Path, name: str, provenance: dict[str, Any]) -> str:
    """Return where an input of the bake lies: where it lay then, or else where it lay as seen from the shot."""
    from ssilk_usd.read_stage import split_location

    path = Path(provenance["request"][name])
    beside = shot.parent / provenance.get("beside", {}).get(name, path)
    there = next(
        (candidate for candidate in (path, beside) if Path(split_location(str(candidate))[0]).exists()), None
    )
    if there is None:
        fail(str(shot), f"the {name} that it was baked from is not at {path}", f"--{name} says where it lies now")
    return str(there)
