# SPDX-License-Identifier: Apache-2.0
"""What is baked, over which motions, at which quality, and for whom."""

from __future__ import annotations

import argparse
from pathlib import Path

from ...delivery.bake import naming
from ...delivery.bake.request import (
    ALL_ELEMENTS,
    LATENT_ELEMENTS,
    MAX_HANDLES,
    MAX_HOLD,
    MAX_PRE_ROLL,
    MAX_REFINE,
    MAX_SAMPLES_PER_FRAME,
    REFINED_OUTPUTS,
)
from ...delivery.targets import TARGETS
from ...quality.levels import QUALITIES
from .bodies import BODIES
from .fabric import add_known_fabric
from .motions import add_range
from .numbers import RATE, NumberRange
from .world import add_world


def add_bake(verb: argparse.ArgumentParser) -> None:
    """Add the options that say what is baked, over what, and for whom."""
    _add_inputs(verb)
    _add_course(verb)
    add_known_fabric(verb)
    add_world(verb, "with --refine and --quality hero; the network alone feels wind and gravity, and sees colliders "
                    "where it was trained with some")  # fmt: skip
    _add_names(verb)
    _add_output(verb)


def _add_inputs(verb: argparse.ArgumentParser) -> None:
    """Add the models, the stages, the motions, and who receives the shot."""
    verb.add_argument("model", nargs="+", metavar="MODEL|LIST[:/ROOT]",
                      help="models written by 'ssilk train', or the list that 'ssilk wardrobe' left beside its "
                           "models, which stands for all of these; ROOT is the SkelRoot that wears it, where the "
                           "stage has several")  # fmt: skip
    verb.add_argument(
        "--stage",
        type=Path,
        action="append",
        required=True,
        help=BODIES,
    )
    motions = verb.add_mutually_exclusive_group(required=True)
    motions.add_argument(
        "--motion",
        nargs="+",
        metavar="SHOT[:/PRIM]",
        help="USD files with motions; PRIM is the SkelAnimation, where there are several",
    )
    motions.add_argument("--shots", type=Path, metavar="LIST",
                         help='JSON file of named shots, {"s010": "s010/anim.usdc", ...}; paths are relative to '
                              "it")  # fmt: skip
    about = "; ".join(f"{name}: {target.about}" for name, target in TARGETS.items())
    verb.add_argument("--target", choices=TARGETS, default="usd", help=f"who receives it (default usd). {about}")


def _add_course(verb: argparse.ArgumentParser) -> None:
    """Add the options that say which frames are baked, and how the garment goes through them."""
    verb.add_argument("--fps", type=RATE, help="frames per second of the shot (default: the motion's)")
    add_range(verb, "frames to bake", "the range of the motion's stage, or all")
    verb.add_argument("--handles", type=NumberRange(0, MAX_HANDLES, int), default=0, metavar="N",
                      help="frames before and after the range that are baked as well, where there are samples "
                           "(default 0)")  # fmt: skip
    verb.add_argument("--samples-per-frame", type=NumberRange(1, MAX_SAMPLES_PER_FRAME, int), default=1, metavar="N",
                      help="samples in each frame, for motion blur (default 1)")  # fmt: skip
    verb.add_argument(
        "--pre-roll",
        type=NumberRange(0, MAX_PRE_ROLL),
        default=0.0,
        metavar="SECONDS",
        help="run-up to the first pose and after each cut, so that the garment has settled (default 0)",
    )
    verb.add_argument("--start-cloth", metavar="FILE[:/PRIM][@CODE]",
                      help="shot or point cache that this one goes on from: its last frame, or that at a time code, "
                           "is the first one here, and its cloth is there (default: it is at rest)")  # fmt: skip
    verb.add_argument("--hold", type=NumberRange(1, MAX_HOLD, int), metavar="N",
                      help="frames for which each pose of the garment is held, 2 for animation on twos (default: "
                           "ssilk:hold of the garment in the shot, or 1)")  # fmt: skip
    verb.add_argument("--loop", action="store_true",
                      help="the motion is a cycle: play it until the garment repeats, and write one round whose last "
                           "frame flows into its first (default: ssilk:loop of the garment in the shot)")  # fmt: skip


def _add_names(verb: argparse.ArgumentParser) -> None:
    """Add the options that say how garments and shots are named in a folder, and what assets say of themselves."""
    about = f"Names are those in a folder of layers. In a pattern, {naming.FIELDS}."
    names = verb.add_argument_group("names and versions", about)
    names.add_argument("--shot-name", metavar="PATTERN",
                       help="such as s010 for one motion, or '{parent2}_{stem}' (default: the file's, and the prim's "
                            "where one is named)")  # fmt: skip
    names.add_argument("--garment-name", metavar="PATTERN",
                       help="such as cape, or '{parent}' (default: the model's, with ROOT in front)")  # fmt: skip
    names.add_argument("--body-name", metavar="PATTERN",
                       help="such as heavy, or '{parent}': what names of shots and garments begin with, one for each "
                            "stage (default: the stage's where several are given, else none)")  # fmt: skip
    names.add_argument("--level-of", metavar="GARMENT",
                       help="these are levels of quality of a garment of the shot: variants of its prim")  # fmt: skip
    names.add_argument("--asset-version", metavar="PATTERN",
                       help="of the garment, in the assetInfo of what is written, such as v012, or '{parent}' "
                            "(default: what the asset has, else a hash of the model)")  # fmt: skip
    names.add_argument("--asset-identifier", metavar="PATTERN",
                       help="likewise, such as 'studio:/cloth/{stem}' (default: what the asset has, else its own "
                            "layer; none in a file)")  # fmt: skip
    names.add_argument("--replace", action="store_true",
                       help="bake even where a name was used for another input, or an asset has another "
                            "version")  # fmt: skip


def _add_output(verb: argparse.ArgumentParser) -> None:
    """Add the options that say what becomes of the garment, and what is written with it."""
    verb.add_argument("--lbs", action="store_true", help="bake linear blend skinning instead of the network")
    verb.add_argument("--points", action="store_true", help="write point caches as well (folders)")
    verb.add_argument(
        "--refine",
        type=NumberRange(0, MAX_REFINE, int),
        default=0,
        metavar="N",
        help="iterations of the simulator's solver in each frame, from the network's state (default 0)",
    )
    verb.add_argument(
        "--feedback",
        action="store_true",
        help="refined frames look back on refined ones: the garment follows the solver, not the network",
    )
    verb.add_argument(
        "--latent-iterations",
        type=NumberRange(0, MAX_REFINE, int),
        default=0,
        metavar="N",
        help="iterations of a solver in the model's latents in each frame, instead of the network's step (default 0)",
    )
    verb.add_argument(
        "--latent-elements",
        choices=LATENT_ELEMENTS,
        default=ALL_ELEMENTS,
        help="that solver sums the energy over the whole garment (default), or over few of its elements: some "
        "four times as fast, less exact in wild motion",
    )
    verb.add_argument(
        "--refined-output",
        choices=REFINED_OUTPUTS,
        default=REFINED_OUTPUTS[0],
        help="refined garments as joints and blendshapes of the shot's own (default), or as time-sampled points",
    )
    verb.add_argument(
        "--certify",
        action="store_true",
        help="move frames as little as it takes until, in the written file, no triangle of the garment intersects "
        "another and no covered skin shows; say which have no free position",
    )
    verb.add_argument("--no-body", action="store_true", help="leave the body meshes out")
    verb.add_argument(
        "--hide-covered",
        action="store_true",
        help="hide the body's faces that the garment covers in every frame, where skin shows through: a last resort",
    )
    verb.add_argument("--no-verify", action="store_true", help="do not re-skin the written files")
    verb.add_argument("--device", default="cpu", help="where the network runs (default cpu)")


def add_level(verb: argparse.ArgumentParser, size: str, *, plays: bool = False) -> None:
    """Add --quality and --budget; `size` says of what a budget in bytes is, `plays` that levels limit the rate."""
    rates = {
        level.name: f", at most {level.fps:g} frames a second" for level in QUALITIES.values() if plays and level.fps
    }
    levels = "; ".join(f"{level.name}: {level.about}{rates.get(level.name, '')}" for level in QUALITIES.values())
    verb.add_argument("--quality", choices=QUALITIES, help=f"level of quality ({levels})")
    verb.add_argument("--budget", metavar="AMOUNT", help=f"keep the most within 0.3ms for each frame, or {size}")
