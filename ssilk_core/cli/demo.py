# SPDX-License-Identifier: Apache-2.0
"""Film a garment that ships beside linear blend skinning, then train a draft of it and film all three.

The demo consists of commands that can be typed; each is printed before it runs. --pretrained leaves out the training.
Three choices train nothing: --garment cape_over_dress films an outfit, a cape that was trained over the hooded dress,
and the dress; --garment cape_family films one model of the cape on three bodies side by side, and --garment
cape_fabrics the cape in three fabrics. The outfit's list, outfit.toml, is written to inspect and train it anew.
"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import EXIT_OK, EXIT_WORSE
from ..events import Message, Reporter, Result

if TYPE_CHECKING:
    from ..scene.assets import Mesh

RANGED_GARMENT = "cape"  # whose model knows a range of fabrics, and of which one for a family of bodies ships
FAMILY, FABRICS = "cape_family", "cape_fabrics"  # choices: the model for a family, and the cape in three fabrics
FILMED_FABRICS = ("silk", "default", "leather")
FILMED_BODIES = {"neutral": "", "tall": "tall", "heavy": "heavy"}  # by their captions
PRESET = "draft"  # of the training: the only one that a processor finishes while someone waits


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    verb.add_argument(
        "-o", "--output", type=Path, default=Path("demo_out"), metavar="FOLDER",
        help="folder for everything that the demo writes (default demo_out)",
    )  # fmt: skip
    verb.add_argument(
        "--garment", choices=("cape", "fringe_skirt", "hooded_dress", "cape_over_dress", FAMILY, FABRICS),
        default="cape", help="garment, an outfit of two, one on three bodies or in three fabrics (default cape)",
    )  # fmt: skip
    verb.add_argument("--pretrained", action="store_true", help="show the shipped model only")
    verb.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", dest="settings", help="as in 'ssilk train'"
    )


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Make the inputs, then run the commands; the first that fails ends the demo with its exit code."""
    from ..demo.garments import OVER
    from ..demo.shipped import open_shipped, origin

    outfit = OVER.get(options.garment, ())
    wardrobe = _make_inputs(options, report)
    ranged = options.garment in (FAMILY, FABRICS)
    garment = RANGED_GARMENT if ranged else options.garment
    model = FAMILY if options.garment == FAMILY else garment
    report(Message(f"shipped {model}: {origin(open_shipped(model, wardrobe[garment]))}"))
    if options.garment == FAMILY:
        _make_shots(options.output, report)
        commands = _on_bodies(options)
    elif options.garment == FABRICS:
        commands = _in_fabrics(options)
    else:
        commands = _outfit(options, outfit[1:]) if outfit else _shipped(options)
    trains = not (outfit or options.pretrained or ranged)
    if trains:
        commands += _trained(options)
        first = "shipped.mp4, which comes first, has every second frame: that saves half a minute"
        report(Message(f"{first}; {PRESET}.mp4 has all, of the same shots beside the draft"))
    for command in commands:
        report(Message("\n$ ssilk " + shlex.join(command)))
        code = options.main([*command, "--json"] if options.json else command)
        if code not in (EXIT_OK, EXIT_WORSE):  # a draft that is worse than none is filmed, too
            return code
    shown = ["shipped", PRESET] if trains else ["shipped"]
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
        # Each frame takes a core 0.3 s, and the film after the training has all of these.
        *_views(
            out / "shipped",
            {name: shots[name] for name in ("linear blend skinning", "shipped")},
            fps=30 if options.pretrained else 15,
        ),
    ]


def _outfit(options: argparse.Namespace, inner: Sequence[str]) -> list[list[str]]:
    """Return the commands that bake and film a shipped garment over those beneath it, inner ones first."""
    from ..demo.shipped import shipped_path

    out = options.output
    models = [str(shipped_path(name)) for name in (*inner, options.garment)]
    bake = ["bake", *models, "--stage", str(_body()), "--motion", str(out / "shot.usdc")]
    folders = {"linear blend skinning": out / "outfit_lbs", "shipped": out / "outfit"}
    shots = {name: str(folder / "shots" / "shot" / "shot.usda") for name, folder in folders.items()}
    return [
        [*bake, "-o", str(folders["linear blend skinning"]), "--lbs"],
        [*bake, "-o", str(folders["shipped"])],
        *_views(out / "shipped", shots, fps=30),
    ]


def _on_bodies(options: argparse.Namespace) -> list[list[str]]:
    """Return the commands that bake one model on three bodies, each from its own stage, and film them."""
    from ssilk_usd.stages import demo_body_path

    from ..demo.shipped import shipped_path

    out, model = options.output, str(shipped_path(FAMILY))
    shots = {caption: str(out / f"{RANGED_GARMENT}_{caption}.usdc") for caption in FILMED_BODIES}
    return [
        *(
            ["bake", model, "--stage", str(demo_body_path(name)), "--motion", str(out / f"shot_{caption}.usdc"),
             "-o", shots[caption]]
            for caption, name in FILMED_BODIES.items()
        ),
        *_views(out / "shipped", shots, fps=30),
    ]  # fmt: skip


def _in_fabrics(options: argparse.Namespace) -> list[list[str]]:
    """Return the commands that rig the garment, bake one model of it in three fabrics, and film them."""
    from ..demo.shipped import shipped_path

    out, stage = options.output, _stage(options)
    shots = {fabric: str(out / f"{RANGED_GARMENT}_{fabric}.usdc") for fabric in FILMED_FABRICS}
    return [
        ["rig", str(_body()), "--garment", str(out / "wardrobe" / f"{RANGED_GARMENT}.usdc"), "-o", stage],
        *(
            ["bake", str(shipped_path(RANGED_GARMENT)), "--stage", stage, "--motion", str(out / "shot.usdc"),
             "--fabric", fabric, "-o", shots[fabric]]
            for fabric in FILMED_FABRICS
        ),
        *_views(out / "shipped", shots, fps=30),
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


def _make_inputs(options: argparse.Namespace, report: Reporter) -> dict[str, Mesh]:
    """Write the wardrobe, the motions to train on, and the shot to bake; return the wardrobe.

    For an outfit, its list is written as well.
    """
    from ssilk_usd.reading.character import read_character
    from ssilk_usd.writing.files import write_garment, write_motion

    from ..demo.garments import GARMENTS, OVER, build_garment
    from ..demo.motions import demo_shot, training_motions
    from ..training.wardrobe.listing import write_list

    out, character = options.output, read_character(_body())
    over = OVER.get(options.garment, ())
    named = [*GARMENTS, options.garment] if over else GARMENTS
    wardrobe = {name: build_garment(name, character).mesh for name in named}
    for name, mesh in wardrobe.items():
        write_garment(out / "wardrobe" / f"{name}.usdc", mesh)
        report(Message(f"made {name}: {mesh.vertex_count} vertices"))
    motions = training_motions(character.skeleton)
    for number, motion in enumerate(motions):
        write_motion(out / "motions" / f"{number:02d}_{motion.path}.usdc", motion, character.skeleton)
    write_motion(out / "shot.usdc", demo_shot(character.skeleton), character.skeleton)
    if over:
        table = {"stage": str(_body()), "motions": str(out / "motions"), "material": {"tether": 5000}}
        tables = {name: {**table, "garment": str(out / "wardrobe" / f"{name}.usdc")} for name in over[1:]}
        own = {**table, "garment": str(out / "wardrobe" / f"{options.garment}.usdc"), "over": [*over[1:]]}
        write_list(out / "outfit.toml", {**tables, options.garment: own})
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
        moved = motion_on(shot, base, character.skeleton, family.height_ratio(coordinates))
        write_motion(out / f"shot_{caption}.usdc", moved, character.skeleton)
    report(Message(f"made a shot for each of {len(characters)} bodies"))
