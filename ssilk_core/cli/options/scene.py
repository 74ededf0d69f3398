# SPDX-License-Identifier: Apache-2.0
"""Which character and garment of a stage are meant, and how they are read."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from ...errors import fail
from ...events import Reporter
from ...files import split_body, split_location

if TYPE_CHECKING:
    from ...authoring.setup.rig import RigOptions
    from ...scene.assets import Character, Garment, Mesh, ProxyRig, Scene

STAGE = "USD file with the character (SkelRoot, Skeleton, body meshes)"


def add_scene(verb: argparse.ArgumentParser) -> None:
    """Add the options that name the character and the garment."""
    verb.add_argument("stage", type=Path, help=STAGE)
    add_garment(verb)


def add_garment(verb: argparse.ArgumentParser) -> None:
    """Add the options that name what is taken of a stage."""
    verb.add_argument(
        "--garment", metavar="FILE[:/PRIM]|PRIM", help="garment: a file of its own, or a mesh of the stage"
    )
    verb.add_argument("--root", metavar="PRIM", help="SkelRoot of the character, where the stage has several")
    verb.add_argument(
        "--body",
        metavar="PRIM",
        action="append",
        default=[],
        help="body mesh (repeatable; default: all under the SkelRoot, without those that ^PRIM names)",
    )


def garment_location(options: argparse.Namespace) -> tuple[Path, str | None]:
    """Return the file that holds the garment, and the prim that was asked for."""
    from ssilk_usd.opening.stage import USD_SUFFIXES

    file, prim = split_location(options.garment) if options.garment else ("", None)
    return (Path(file), prim) if Path(file).suffix in USD_SUFFIXES else (options.stage, options.garment)


def read_stage(options: argparse.Namespace, report: Reporter) -> tuple[Character, Garment, ProxyRig | None]:
    """Read the character, the garment and its authored rig, as the options of `add_scene` say."""
    from ssilk_usd.reading.scene import read_scene

    file, shapes = split_body(str(options.stage))
    if not Path(file).exists():
        fail(str(options.stage), "there is no such file", "a USD stage with a character is needed")
    if shapes and garment_location(options)[0] == options.stage:
        found = "the stage's own garment, on a body that weights of its shapes make"
        fail(str(options.stage), found, "the garment lies as on the body of the stage itself",
             f"'ssilk rig {file} --onto {shapes}' puts it on that one")  # fmt: skip
    return read_scene(options.stage, root=options.root, bodies=options.body, garment=options.garment, report=report)


def load_scene(
    options: argparse.Namespace,
    report: Reporter,
    *,
    rigging: RigOptions | None = None,
) -> Scene:
    """Read a scene and make the weights, classes and rig that it lacks, as `rigging` says."""
    from ...authoring.setup.prepare import prepare_scene

    character, garment, rig = read_stage(options, report)
    return prepare_scene(character, garment, rig, rig_options=rigging, report=report)


def garment_under_riders(options: argparse.Namespace, garment: Mesh) -> Callable[[], Mesh] | None:
    """Return what reads a garment where riders of its stage lie on it; None where that is on the body that it is on.

    A body that weights of the stage's shapes make has the garment from elsewhere, and riders from the stage.
    """
    from ssilk_usd.reading.scene import read_scene

    file, shapes = split_body(str(options.stage))
    name = (split_location(garment.path)[1] or garment.path).rpartition("/")[2]
    return (lambda: read_scene(file, root=options.root, garment=name)[1].mesh) if shapes else None
