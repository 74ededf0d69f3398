# SPDX-License-Identifier: Apache-2.0
"""Solve for a garment while a program plays its character: what live playback in Blender runs.

Motions come in through standard input, and frames go out through standard output as they are solved, as binary
messages (ssilk_core/delivery/live/messages.py). Frames are those that 'ssilk bake' writes with the same options. A
motion that takes the place of another one is solved from where they differ on. The end of standard input ends it.
"""

from __future__ import annotations

import argparse
import os
import sys

from ..delivery.bake import BakeRequest, load_garment
from ..delivery.bake.request import ALL_ELEMENTS, LATENT_ELEMENTS, MAX_PRE_ROLL, MAX_REFINE
from ..errors import EXIT_OK, fail
from ..events import Reporter
from ..quality.levels import QUALITIES
from .options.fabric import add_known_fabric
from .options.numbers import NumberRange

OVER_PIPE = "-"  # in place of the motion's file


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    verb.add_argument("model", help="model written by 'ssilk train'")
    verb.add_argument("--stage", required=True, help="USD file with the character")
    verb.add_argument("--root", metavar="PRIM", help="SkelRoot of the character, where the stage has several")
    verb.add_argument("--pre-roll", type=NumberRange(0, MAX_PRE_ROLL), default=0.0, metavar="SECONDS",
                      help="run-up to the first pose and after each cut (default 0)")  # fmt: skip
    verb.add_argument("--latent-iterations", type=NumberRange(1, MAX_REFINE, int), metavar="N",
                      default=QUALITIES["latent"].latent_iterations,
                      help="iterations of the solver in each frame (default %(default)s)")  # fmt: skip
    verb.add_argument("--latent-elements", choices=LATENT_ELEMENTS, default=ALL_ELEMENTS,
                      help="sum the energy over the whole garment (default), or over few of its elements, which are "
                           "chosen for the first motion")  # fmt: skip
    add_known_fabric(verb)
    verb.add_argument("--device", default="cpu", help="where it is solved (default cpu)")


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Serve until the input ends."""
    from ..delivery.live.service import serve

    if options.json:
        fail("--json", "events on standard output", "messages go there", "leave it out")
    # What libraries print would break the messages. The input has no buffer, whose lock a thread that still reads
    # would hold when this process ends.
    outgoing = os.fdopen(os.dup(sys.stdout.fileno()), "wb", buffering=0)
    with outgoing, open(sys.stdin.fileno(), "rb", buffering=0, closefd=False) as incoming:
        os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
        request = BakeRequest(
            model=options.model, stage=options.stage, motion=OVER_PIPE, root=options.root, pre_roll=options.pre_roll,
            latent_iterations=options.latent_iterations, latent_elements=options.latent_elements,
            device=options.device, fabric=options.fabric, material=tuple(options.material),
        )  # fmt: skip
        serve(load_garment(request), incoming, outgoing)
    return EXIT_OK
