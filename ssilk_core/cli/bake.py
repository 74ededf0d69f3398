# SPDX-License-Identifier: Apache-2.0
"""Bake a trained garment over a motion as one UsdSkel shot, and prove it by re-skinning the file.

The shot holds joints, blendshapes and their animation, no vertex caches. --plain bakes the same garment under
plain skinning, to compare with. A shot that fails the proof (exit code 3) is not kept, and an older file of its name
stays as it was.
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from ssilk_core.errors import EXIT_OK
from ssilk_core.events import Message, Reporter, Result, Started
from ssilk_core.files import replacing

from .options import INPUTS, check_output


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    verb.add_argument("model", type=Path, help="model written by 'ssilk train'")
    verb.add_argument("--stage", type=Path, required=True, help="USD file with the character")
    verb.add_argument(
        "--motion",
        type=Path,
        required=True,
        metavar="SHOT[:/PRIM]",
        help="USD file with the motion; PRIM is the SkelAnimation, where there are several",
    )
    verb.add_argument("-o", "--output", type=Path, required=True, help="shot to write (.usdc, .usd or .usda)")
    verb.add_argument("--fps", type=float, help="frames per second of the shot (default: the motion's)")
    verb.add_argument("--root", metavar="PRIM", help="SkelRoot of the character, where the stage has several")
    verb.add_argument("--plain", action="store_true", help="bake plain skinning instead of the network")
    verb.add_argument("--no-body", action="store_true", help="leave the body meshes out")
    verb.add_argument("--no-verify", action="store_true", help="do not re-skin the written file")
    verb.add_argument("--device", default="cpu", help="where the network runs (default cpu)")


def _beside(options: argparse.Namespace) -> dict[str, str]:
    """Return the inputs' paths as seen from the shot's folder: they hold when everything moves together."""
    folder = options.output.absolute().parent
    try:
        return {name: os.path.relpath(getattr(options, name), folder) for name in INPUTS}
    except ValueError:  # on another drive
        return {}


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Bake and verify."""
    from ssilk_usd.read_stage import split_location
    from ssilk_usd.shot import write_shot

    from ._baking import BakeRequest, open_bake

    check_output(options.output, options.model, options.stage, split_location(str(options.motion))[0])
    bake = open_bake(
        BakeRequest(
            model=str(options.model),
            stage=str(options.stage),
            motion=str(options.motion),
            fps=options.fps,
            root=options.root,
            plain=options.plain,
            device=options.device,
        )
    )
    report(Started("bake", bake.motion.frame_count, {"output": str(options.output)}))
    with replacing(options.output) as unproven:
        summary = write_shot(
            unproven,
            bake.deformer,
            bake.motion,
            bake.poses(),
            units=bake.units,
            start=bake.motion.start,
            include_body=not options.no_body,
            provenance={**bake.provenance, "beside": _beside(options), "recovered": bake.recovered},
        )
        for frames in bake.recovered:
            report(Message(f"frames {frames}: the rollout was lost, and the garment is put to rest", "warning"))
        if options.no_verify:
            report(Message("not verified, as asked", "warning"))
        proof = {} if options.no_verify else bake.verify(unproven, report)
    detail: dict[str, object] = {
        "shot": str(options.output),
        "frames": summary.frame_count,
        "fps": summary.fps,
        "joints": summary.joint_count,
        "proxies": summary.proxy_count,
        "blendshapes": summary.shape_count,
        "bytes": options.output.stat().st_size,
        **({"put to rest": bake.recovered} if bake.recovered else {}),
        **proof,
    }
    report(Result("bake", detail))
    return EXIT_OK
