# SPDX-License-Identifier: Apache-2.0
"""Film a garment that ships beside linear blend skinning, then train a draft of it and film all three.

The demo consists of commands that can be typed; each is printed before it runs. --pretrained leaves out the training.
--family films one model of the cape on three bodies side by side, and trains nothing.
"""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import EXIT_OK, EXIT_WORSE, fail
from ..events import Message, Reporter, Result

if TYPE_CHECKING:
    from ..scene.assets import Mesh

FAMILY = "cape"  # the garment of which a model for a family of bodies ships
FILMED_BODIES = {"neutral": "", "tall": "tall", "heavy": "heavy"}  # by their captions
PRESET = "draft"  # of the training: the only one that a processor finishes while someone waits


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    verb.add_argument(
        "-o", "--output", type=Path, default=Path("demo_out"), metavar="FOLDER",
        help="folder for everything that the demo writes (default demo_out)",
    )  # fmt: skip
    verb.add_argument(
        "--garment", choices=("cape", "fringe_skirt", "hooded_dress"), default="cape", help="garment (default cape)"
    )
    shown = verb.add_mutually_exclusive_group()
    shown.add_argument("--pretrained", action="store_true", help="show the shipped model only")
    shown.add_argument("--family", action="store_true", dest="on_bodies",
                       help=f"show the model of the {FAMILY} for a family of bodies, on three of them")  # fmt: skip
    verb.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", dest="settings", help="as in 'ssilk train'"
    )


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Make the inputs, then run the commands; the first that fails ends the demo with its exit code."""
    from ..demo.shipped import FAMILY_SUFFIX, open_shipped, origin

    if options.on_bodies and options.garment != FAMILY:
        found = f"--family with --garment {options.garment}"
        fail("demo", found, f"a model for a family of bodies ships of the {FAMILY}", "leave one of both out")
    wardrobe = _make_inputs(options.output, report)
    model = options.garment + (FAMILY_SUFFIX if options.on_bodies else "")
    shipped = open_shipped(model, wardrobe[options.garment])
    report(Message(f"shipped {model}: {origin(shipped)}"))
    if options.on_bodies:
        _make_shots(options.output, report)
        commands = _on_bodies(options)
    else:
        commands = _shipped(options) + ([] if options.pretrained else _trained(options))
    for command in commands:
        report(Message("\n$ ssilk " + shlex.join(command)))
        code = options.main([*command, "--json"] if options.json else command)
        if code not in (EXIT_OK, EXIT_WORSE):  # a draft that is worse than none is filmed, too
            return code
    shown = ["family"] if options.on_bodies else ["shipped"] if options.pretrained else ["shipped", PRESET]
    report(Result("demo", {f"{name} film": str(options.output / f"{name}.mp4") for name in shown}))
    return EXIT_OK


def _shipped(options: argparse.Namespace) -> list[list[str]]:
    """Return the commands that rig the garment onto the demo's body, and bake and film the shipped model on it."""
    from ..demo.shipped import shipped_path

    shots, out, stage = _shots(options), options.output, _stage(options)
    bake = ["bake", str(shipped_path(options.garment)), "--stage", stage, "--motion", str(out / "shot.usdc")]
    return [
        ["rig", str(_body()), "--garment", str(out / "wardrobe" / f"{options.garment}.usdc"), "-o", stage],
        [*bake, "-o", shots["linear blend skinning"], "--lbs"],
        [*bake, "-o", shots["shipped"]],
        # The film after the training has every frame of these shots; half of them are enough until then.
        *_views(
            out / "shipped",
            {name: shots[name] for name in ("linear blend skinning", "shipped")},
            fps=30 if options.pretrained else 15,
        ),
    ]


def _on_bodies(options: argparse.Namespace) -> list[list[str]]:
    """Return the commands that bake one model on three bodies, each from its own stage, and film them."""
    from ssilk_usd.stages import demo_body_path

    from ..demo.shipped import FAMILY_SUFFIX, shipped_path

    out, model = options.output, str(shipped_path(FAMILY + FAMILY_SUFFIX))
    shots = {caption: str(out / f"{FAMILY}_{caption}.usdc") for caption in FILMED_BODIES}
    return [
        *(
            ["bake", model, "--stage", str(demo_body_path(name)), "--motion", str(out / f"shot_{caption}.usdc"),
             "-o", shots[caption]]
            for caption, name in FILMED_BODIES.items()
        ),
        *_views(out / "family", shots, fps=30),
    ]  # fmt: skip


def _trained(options: argparse.Namespace) -> list[list[str]]:
    """Return the commands that train the garment as it is rigged, and film it beside LBS and the shipped model."""
    out, garment, shots, stage = options.output, options.garment, _shots(options), _stage(options)
    model = str(out / f"{garment}_{PRESET}.safetensors")
    settings = [word for setting in options.settings for word in ("--set", setting)]
    return [
        ["train", stage, "--motions", str(out / "motions"), "-o", model, "--preset", PRESET, *settings],
        ["bake", model, "--stage", stage, "--motion", str(out / "shot.usdc"), "-o", shots[PRESET]],
        *_views(out / PRESET, shots, fps=30),
    ]


def _stage(options: argparse.Namespace) -> str:
    """Return the file of the character with the garment."""
    return str(options.output / f"{options.garment}_stage.usdc")


def _shots(options: argparse.Namespace) -> dict[str, str]:
    """Return the shots by the captions of their panels, in the order of the film."""
    files = {"linear blend skinning": "lbs", PRESET: f"{options.garment}_{PRESET}"}
    files["shipped"] = f"{options.garment}_shipped"
    return {name: str(options.output / f"{file}.usdc") for name, file in files.items()}


def _views(stem: Path, shots: dict[str, str], fps: int) -> list[list[str]]:
    """Return the commands that draw shots as a sheet and as a film."""
    labels = [word for name in shots for word in ("--label", name)]
    view = ["view", *shots.values(), *labels, "--azimuth", "150"]
    return [
        [*view, "-o", f"{stem}.png", "--columns", "8"],
        [*view, "-o", f"{stem}.mp4", "--size", "320x384", "--fps", str(fps)],
    ]


def _body() -> Path:
    from ssilk_usd.stages import demo_body_path

    return demo_body_path()


def _make_inputs(out: Path, report: Reporter) -> dict[str, Mesh]:
    """Write the wardrobe, the motions to train on, and the shot to bake; return the wardrobe."""
    from ssilk_usd.reading.character import read_character
    from ssilk_usd.writing.files import write_garment, write_motion

    from ..demo.garments import GARMENTS, build_garment
    from ..demo.motions import demo_shot, training_motions

    character = read_character(_body())
    wardrobe = {name: build_garment(name, character).mesh for name in GARMENTS}
    for name, mesh in wardrobe.items():
        write_garment(out / "wardrobe" / f"{name}.usdc", mesh)
        report(Message(f"made {name}: {mesh.vertex_count} vertices"))
    motions = training_motions(character.skeleton)
    for number, motion in enumerate(motions):
        write_motion(out / "motions" / f"{number:02d}_{motion.path}.usdc", motion, character.skeleton)
    write_motion(out / "shot.usdc", demo_shot(character.skeleton), character.skeleton)
    seconds = sum(motion.frame_count / motion.fps for motion in motions)
    report(Message(f"made {len(motions)} motions of {seconds:.0f} s to train on, and a shot to bake"))
    return wardrobe


def _make_shots(out: Path, report: Reporter) -> None:
    """Write the shot to bake for each body: joints turn alike, between the bones of that body."""
    from ssilk_usd.reading.character import read_character
    from ssilk_usd.stages import demo_body_path
    from ssilk_usd.writing.files import write_motion

    from ..demo.motions import demo_shot
    from ..scene.family import BodyFamily, motion_on

    characters = [read_character(demo_body_path(name)) for name in FILMED_BODIES.values()]
    family, base = BodyFamily.of(characters), characters[0].skeleton
    shot = demo_shot(base)
    for caption, character, coordinates in zip(FILMED_BODIES, characters, family.members):
        moved = motion_on(shot, base, character.skeleton, 1 + float(family.taller @ coordinates))
        write_motion(out / f"shot_{caption}.usdc", moved, character.skeleton)
    report(Message(f"made a shot for each of {len(characters)} bodies"))
