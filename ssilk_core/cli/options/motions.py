# SPDX-License-Identifier: Apache-2.0
"""Which frames of motions are meant, and the blendshapes of the character that motions weigh."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from ...errors import fail
from ...events import Message, Reporter
from ...scene.assets.reshaped import reshaped
from ...scene.posed_alike import shaped_as_in_stage

if TYPE_CHECKING:
    from ...scene.assets import Character, Motion


def add_range(verb: argparse.ArgumentParser, what: str, default: str) -> None:
    """Add --range, which `parse_range` reads; `what` it names, and in words what is taken without it."""
    verb.add_argument(
        "--range",
        metavar="FIRST-LAST",
        help=f"{what}, as time codes of the motion, such as 1001-1100, or 'all' that have samples (default: "
        f"{default}); --range=-3-5 where FIRST is negative",
    )


def need_motion_folder(folder: Path) -> None:
    """Raise `SsilkError` where --motions names no folder; for one of its files, say how that is chosen."""
    needed = "a folder of motion files is needed"
    if folder.is_file():
        todo = f"name its folder, and this one with --clips {folder.stem}"
        fail(str(folder), "a file, and no folder", needed, todo)
    if not folder.is_dir():
        fail(str(folder), "there is no such folder", needed)


def tell_shapes(
    options: argparse.Namespace, motions: Iterable[Motion], report: Reporter, *, trained: Character | None = None
) -> None:
    """Warn of motions that show the character's meshes otherwise than its stage; options as `load_scene`.

    Args:
        trained: the character in a training, which has one shape whatever the motions' blendshapes are.
    """
    from ssilk_usd.reading.shown import tell_shown_otherwise

    motions = list(motions)
    chosen = {"root": options.root, "garment": options.garment, "bodies": options.body}
    tell_shown_otherwise(options.stage, [motion.path for motion in motions], report, **chosen)
    if trained is None:
        return
    for motion in motions:
        found = reshaped(trained, with_shapes(options, motion, motion.path, trained))
        if found:
            text = f"{motion.path}: {'; '.join(map(str, found))}"
            report(Message(f"{text}; training sees the shape of the character's stage alone", "warning"))


def with_shapes(options: argparse.Namespace, motion: Motion, source: str | Path, character: Character) -> Motion:
    """Return a motion with the blendshapes of the character that its file weighs; options as `load_scene`."""
    from ssilk_usd.reading.body_shapes import with_body_shapes

    chosen = {"root": options.root, "garment": options.garment}
    return shaped_as_in_stage(
        character, lambda own: with_body_shapes(options.stage, str(source), motion, own, **chosen)
    )
