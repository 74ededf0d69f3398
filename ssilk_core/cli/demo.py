# SPDX-License-Identifier: Apache-2.0
"""Dress the demo body, train a cape as a draft, bake it, verify it, and show it beside plain skinning.

Everything the demo does is a command that can be typed: each is printed before it runs.
"""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

from ssilk_core.errors import EXIT_OK
from ssilk_core.events import Message, Reporter, Result


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    verb.add_argument("--out", type=Path, default=Path("demo_out"), help="folder for all of it (default demo_out)")
    verb.add_argument(
        "--garment", choices=("cape", "fringe_skirt", "hooded_dress"), default="cape", help="what to train"
    )
    verb.add_argument("--preset", default="draft", help="schedule of the training (default draft)")
    verb.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", dest="settings", help="as in 'ssilk train'"
    )


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Make the inputs, then run the commands; the first that fails ends the demo with its exit code."""
    from ssilk_core.cli import main

    _make_inputs(options.out, report)
    for command in _commands(options):
        report(Message("\n$ ssilk " + shlex.join(command)))
        code = main([*command, "--json"] if options.json else command)
        if code != EXIT_OK:
            return code
    report(Result("demo", {"film": str(options.out / "film.mp4"), "contact sheet": str(options.out / "sheet.png")}))
    return EXIT_OK


def _commands(options: argparse.Namespace) -> list[list[str]]:
    out, garment = options.out, options.garment
    stage, model, motion = (
        str(out / f"{garment}_stage.usdc"),
        str(out / f"{garment}.safetensors"),
        str(out / "shot.usdc"),
    )
    plain, baked = str(out / "plain.usdc"), str(out / f"{garment}_shot.usdc")
    view = ["view", plain, baked, "--label", "plain skinning", "--label", "SSILK"]
    settings = [word for setting in options.settings for word in ("--set", setting)]
    return [
        ["rig", str(_body()), "--garment", str(out / "wardrobe" / f"{garment}.usdc"), "-o", stage],
        ["train", stage, "--motions", str(out / "motions"), "-o", model, "--preset", options.preset, *settings],
        ["bake", model, "--stage", stage, "--motion", motion, "-o", baked],
        ["bake", model, "--stage", stage, "--motion", motion, "-o", plain, "--plain"],
        [*view, "-o", str(out / "sheet.png"), "--azimuth", "150", "--columns", "8"],
        [*view, "-o", str(out / "film.mp4"), "--azimuth", "150", "--size", "400x480"],
    ]


def _body() -> Path:
    from ssilk_usd.stages import demo_body_path

    return demo_body_path()


def _make_inputs(out: Path, report: Reporter) -> None:
    """Write the wardrobe, the motions to train on, and the shot to bake."""
    from ssilk_usd.read_character import read_character
    from ssilk_usd.write import write_garment, write_motion

    from ssilk_core.demo.garments import GARMENTS, build_garment
    from ssilk_core.demo.motions import demo_shot, training_motions

    character = read_character(_body())
    for name in GARMENTS:
        mesh = build_garment(name, character).mesh
        write_garment(out / "wardrobe" / f"{name}.usdc", mesh)
        report(Message(f"made {name}: {mesh.vertex_count} vertices"))
    motions = training_motions(character.skeleton)
    for number, motion in enumerate(motions):
        write_motion(out / "motions" / f"{number:02d}_{motion.path}.usdc", motion, character.skeleton)
    write_motion(out / "shot.usdc", demo_shot(character.skeleton), character.skeleton)
    seconds = sum(motion.frame_count / motion.fps for motion in motions)
    report(Message(f"made {len(motions)} motions of {seconds:.0f} s to train on, and a shot to bake"))
