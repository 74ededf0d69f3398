# SPDX-License-Identifier: Apache-2.0
"""Check a shot, and compare it, re-skinned by UsdSkel alone, with the decoder's vertices or its cache.

The stage of a shot in a folder of layers, and a glb of several garments, stand for all of these: each is verified,
and of layers it is counted how they lie over one another. A shot says which model, stage and motion it was baked
from. Give the present paths of those that have moved. A shot that was solved in latents, or refined with feedback, is
only checked for being valid and complete.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ..delivery import bake
from ..errors import EXIT_OK, fail
from ..events import Reporter


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    verb.add_argument("shot", type=Path, help="shot written by 'ssilk bake' or 'ssilk skin'")
    for name in ("model", "stage", "motion", "cache"):
        verb.add_argument(f"--{name}", metavar="PATH", help=f"present path of the {name}")
    verb.add_argument("--device", help="where the network runs (default: where it ran for the bake)")


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Verify; raise `VerificationError` (exit code 3) when the file is not what was computed."""
    if bake.holds_several(options.shot):
        for name in ("model", "stage", "motion", "cache"):
            if getattr(options, name):
                found, allowed = "a shot of several garments", "each names inputs of its own"
                fail(f"--{name}", found, allowed, "verify one garment alone with it, such as its anim.usdc")
        bake.verify_garments(options.shot, device=options.device, report=report)
        return EXIT_OK
    bake.verify(
        options.shot,
        model=options.model,
        stage=options.stage,
        motion=options.motion,
        cache=options.cache,
        device=options.device,
        report=report,
    )
    return EXIT_OK
