# SPDX-License-Identifier: Apache-2.0
"""Bake trained garments over motions as UsdSkel, and verify it by re-skinning the files.

One garment over one motion goes into one file: joints, blendshapes and their animation, no vertex caches. A glb takes
several garments of a character. A folder takes any number of both, as layers: an asset for each garment, a small
layer for each garment in each shot, and a stage for each shot. Layers that are current are left alone.

A file that fails verification (exit code 3) is not kept, and an older file of its name stays as it was. --lbs bakes
the same garments under linear blend skinning, to compare with.

--latent-iterations replaces the network's step by a solver in the model's own latents: in every frame it lowers the
simulator's energy, from where the network would step to. What is written has the size of the network's shot, and no
shape that the model lacks. The result says how far the cloth of a frame may still move.

--refine continues from the network with the simulator's solver in every frame: it lowers the energy of each frame,
and adds wrinkles that no blendshape of the model has. The course of the cloth stays the network's. With --feedback
each frame goes on from what the last ones became, and the cloth follows the solver; with enough iterations this is
the simulator. A refined shot gets blendshapes of its own, as many as it takes to stay within 1 mm (RMS) and 5 mm
(any vertex) of the solver's points; the result says how many, and what the points would take. In one file they
replace the model's, in a folder of layers they come on top, in the shot's own layer. --refined-output points writes
time-sampled points instead, bound to no skeleton; in a folder of layers, they are the variant "points" of
"deformation", beside the network's joints. In a folder of layers or a glb, a garment that was trained over others of
the shot is refined after these, and kept off them; they stay as they are. --over does so for one garment in one file,
over shots that are there.

--certify moves the frames in which triangles of the garment intersect, or covered skin shows, as little as it takes
until none does in the written file, and says which frames have no free position. It adds blendshapes for these frames
alone; all others stay as they are. In a folder of layers or a glb, garments that were trained over others of the shot
are certified over these.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ..delivery import bake as library
from ..delivery.bake.naming import prim_name
from ..delivery.bake.record import ANIMATION
from ..delivery.targets import GLB
from ..errors import EXIT_OK, fail
from ..events import Reporter
from ..files import need_not_input
from ..quality.levels import quality_named
from .options.bake import add_bake, add_level
from .options.files import is_folder
from .options.requests import layer_options, requests_of


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    add_bake(verb)
    verb.add_argument("-o", "--output", type=Path, required=True,
                      help="shot to write (.usdc, .usd, .usda, .usdz or .glb), or a folder of layers")  # fmt: skip
    verb.add_argument("--over", type=Path, nargs="+", default=[], metavar="SHOT",
                      help="shots of garments beneath, over which one garment is refined and certified into one file "
                           "(default: in a folder or glb, those of the shot that it was trained over)")  # fmt: skip
    add_level(verb, "2MB for the shot", plays=True)


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Bake and verify."""
    requests = requests_of(options)
    beneath = _beneath(options, len(requests))
    if is_folder(options.output):
        if options.quality or options.budget:
            fail(
                str(options.output),
                "a level of quality for layers",
                "their assets are the same for all shots",
                "bake models that 'ssilk reduce' made",
            )
        library.bake_layers(requests, options.output, **layer_options(options), report=report)
        return EXIT_OK
    if options.points:
        fail(str(options.output), "one file", "it holds no point cache", "name a folder")
    if options.level_of:
        fail("--level-of", "one file", "levels are variants of a shot in a folder of layers", "name a folder")
    common: dict[str, Any] = {
        "quality": options.quality,
        "budget": options.budget,
        "include_body": not options.no_body,
        "verify": not options.no_verify,
        "report": report,
    }
    if len(requests) > 1:
        library.bake_outfit(requests, options.output, **common)
    else:
        library.bake(requests[0], options.output, beneath=beneath, **common)
    return EXIT_OK


def _beneath(options: argparse.Namespace, count: int) -> dict[str, Path]:
    """Return the shots that a garment is refined and certified over, by their names; `count` is of all that is baked.

    Raises:
        SsilkError: one is not there, two have one name, or nothing is to be done over them.
    """
    if not options.over:
        return {}
    if count > 1 or is_folder(options.output):
        found, allowed = (
            "several garments, or a folder",
            "each is put over those of its shot that it was trained over",
        )
        fail("--over", found, allowed, "leave --over out")
    if not (options.refine or options.certify or (options.quality and quality_named(options.quality).refine)):
        found, allowed = "nothing that moves the garment off them", "cloth is refined or certified over cloth"
        fail("--over", found, allowed, "add --refine N, --quality hero or --certify")
    named = dict[str, Path]()
    for path in options.over:
        if not path.is_file() or path.suffix == GLB:
            fail(str(path), "no file of USD", "--over names shots of garments beneath, each in a file of USD")
        name = path.parent.name if path.name == ANIMATION else path.stem  # as in folders of layers
        if (other := named.setdefault(prim_name(name), path)) != path:
            fail("--over", f"{other} and {path}", "each garment beneath has a name of its own", "rename one of them")
        need_not_input(options.output, path)
    return named
