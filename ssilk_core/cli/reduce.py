# SPDX-License-Identifier: Apache-2.0
"""Cut a trained model down to fewer blendshapes, proxy joints and influences, without training again.

What is kept is the best of its size for the given motions (default: those of the training, if their files are still
there): blendshapes by reduced-rank regression weighted by mass, influences by least squares, proxies by the smallest
error without them. --quality takes the numbers of a level. --budget takes the model with the smallest error that is
fast or small enough: 0.3ms for each frame on this processor, or 6MB for the file. Only the decoder is cut, so the
error does not accumulate over time.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import EXIT_OK, fail
from ..events import Message, Reporter, Result
from ..files import split_location
from ..quality.levels import SizeReduction, size_at, spend
from .options.bake import add_level
from .options.files import check_output
from .options.numbers import NumberRange

NUMBERS = ("shapes", "joints", "influences")

if TYPE_CHECKING:
    from ..network.checkpoint import ModelFile
    from ..quality.reduction import ReducedModel, Reducer
    from ..scene.assets import Motion


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    verb.add_argument("model", type=Path, help="model written by 'ssilk train'")
    verb.add_argument("-o", "--output", type=Path, required=True, help="model to write (.safetensors)")
    for name, what in zip(NUMBERS, ("blendshapes", "proxy joints", "joints that move one vertex")):
        verb.add_argument(
            f"--{name}", type=NumberRange(0, 10**6, int), metavar="N", help=f"{what} to keep (default: all)"
        )
    add_level(verb, "6MB for the file")
    verb.add_argument("--motions", type=Path, nargs="+", default=[], metavar="PATH",
                      help="motion files or folders to keep exact (default: the training's)")  # fmt: skip


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Reduce and write."""
    from ssilk_usd.reading.motion import motion_files

    from ..network.checkpoint import load_model, save_model
    from ..quality.reduction import Reducer

    if options.output.suffix != ".safetensors":
        fail(str(options.output), "not a name for a model", "it ends in .safetensors")
    check_output(options.output, options.model, *motion_files(options.motions))
    file = load_model(options.model)
    if file.bodies:
        text = "a model of a family of bodies: what is kept is the best for the first of them, and is kept for all"
        report(Message(f"{options.model}: {text}"))
    if file.fabrics:
        text = "a model of a range of fabrics: what is kept is the best for its own fabric, and is kept for all"
        report(Message(f"{options.model}: {text}"))
    motions = _motions(file, options)
    reducer = Reducer(file, motions)
    found = _chosen(options, reducer, motions, report)
    figures = SizeReduction.of(reducer.whole, found).to_metadata()
    told = {"model": str(options.model), "motions": [motion.path for motion in motions], **figures}
    provenance = {**file.provenance, "reduced": told}
    save_model(options.output, replace(found.file, provenance=provenance), pack=True)
    detail = {"model": str(options.output), **figures, "bytes": options.output.stat().st_size}
    report(Result("reduce", detail))
    return EXIT_OK


def _motions(file: ModelFile, options: argparse.Namespace) -> list[Motion]:
    """Read the motions that were named, or those of the training whose files are still there."""
    from ssilk_usd.reading.motion import read_motions

    known = file.provenance.get("motions", {})
    there = [path for path in known if Path(split_location(path)[0]).is_file()]
    if not (options.motions or there):
        fail(
            str(options.model),
            "the motions of its training are not where they were",
            "what is kept is fitted to motions, as 'ssilk bake --quality' fits it to the motion that it bakes",
            "name motion files or folders with --motions",
        )
    return read_motions(options.motions or there, file.scene.character.skeleton)


def _chosen(options: argparse.Namespace, reducer: Reducer, motions: list[Motion], report: Reporter) -> ReducedModel:
    """Return the model that the options ask for."""
    from ..quality.cost import model_bytes

    named = {name: value for name in NUMBERS if (value := getattr(options, name)) is not None}
    size = replace(size_at(options.quality, reducer.whole), **named)
    if not options.budget:
        return reducer.reduce(size)
    return spend(options.budget, reducer, size, motions[0], lambda file: model_bytes(file, pack=True), report)
