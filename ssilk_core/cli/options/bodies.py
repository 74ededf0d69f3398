# SPDX-License-Identifier: Apache-2.0
"""Bodies beside that of the stage: of a family, or on another skeleton."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from ...errors import fail
from ...events import Message, Reporter, format_count
from ...files import is_same_file, split_body, split_location
from ...scene.shape_weights import bodies_within, body_name, body_of, parse_shapes, shapes_text
from .scene import garment_location

if TYPE_CHECKING:
    from ...scene.assets import Character
    from ...training.wardrobe.listing import WardrobeEntry

BODIES = "USD file with the character, or FILE:SHAPE=WEIGHT,... (repeatable: one for each body of a family)"


def need_onto(options: argparse.Namespace) -> None:
    """Raise `SsilkError` for --joints without --onto."""
    if options.joints and not options.onto:
        allowed = "a map says which joints of --onto stand for those of the garment's character"
        fail(f"--joints {options.joints}", "no --onto", allowed, "name a character with --onto")


def read_onto(options: argparse.Namespace, report: Reporter) -> Character:
    """Read the character of --onto, "STAGE[:/ROOT]", which has another skeleton: --root and --body name others."""
    from ssilk_usd.reading.character import read_character

    file, root = onto_place(options)
    if not Path(split_body(file)[0]).exists():
        fail(file, "there is no such file", "a USD stage with a character is needed")
    return read_character(file, root=root, report=report)


def onto_place(options: argparse.Namespace) -> tuple[str, str | None]:
    """Return where the character of --onto is, which may be weights of the stage's shapes, and its root."""
    file, root = split_location(str(options.onto))
    return body_of(file, str(options.stage)), root


def read_member(options: argparse.Namespace, location: str, report: Reporter, root: str | None = None) -> Character:
    """Read another body of the character; a body of its own stage has its garment too, which is none of the body."""
    from ssilk_usd.reading.character import read_character

    file, prim = garment_location(options)
    stage = split_body(str(options.stage))[0]
    own = is_same_file(split_body(location)[0], stage) and is_same_file(file, stage)
    root, garment = root or options.root, prim if own else None
    return read_character(location, root=root, bodies=options.body, garment=garment, report=report)


def bodies_in_list(entry: WardrobeEntry, entries: Sequence[WardrobeEntry], folder: Path) -> list[str]:
    """Return the paths of the bodies that a garment of a list meets, where its stage has others of the list as well.

    Garments that a stage does not mark as such count as bodies, and would be met twice: as bodies that move with the
    skeleton, and as the garments that they are. Nothing where none would.

    Args:
        folder: that of the list, to which its paths are relative.

    Raises:
        SsilkError: the stage has no character.
    """
    from ssilk_usd.reading.character import bodies_beside

    from ...training.wardrobe.listing import garment_file

    table = entry.located(folder)
    stage, (file, own) = Path(table["stage"]), garment_file(table)
    if not Path(split_body(str(stage))[0]).is_file():
        return []  # which is told where it is read
    others = [garment_file(each.located(folder)) for each in entries if each is not entry]
    beside = [prim for other, prim in others if prim and is_same_file(other, stage)]
    return bodies_beside(str(stage), beside, own if file == str(stage) else None) if beside else []


def members(options: argparse.Namespace, report: Reporter) -> list[str]:
    """Return where the bodies of --family are, as `open_stage` takes them.

    Without a word, --family means bodies within the ranges of all shapes that the stage marks as body parameters:
    each shape alone, and combinations of all. It says which these are.

    Raises:
        SsilkError: it marks none, or a body is named twice.
    """
    if options.family is None:
        return []
    if options.family:
        named = [_as_compared(body_of(str(member), str(options.stage))) for member in options.family]
        if twice := next((each for each in named if named.count(each) > 1), None):
            fail(f"--family {twice}", "a body that is named twice", "each is named once", "leave one out")
        return named
    from ssilk_usd.opening.shaped import body_parameters
    from ssilk_usd.opening.stage import open_stage

    file, known = split_body(str(options.stage))[0], body_parameters(open_stage(options.stage))
    marked = {name: each for name, each in known.items() if each.is_marked}
    if not marked:
        there = f"its blendshapes are {', '.join(known)}" if known else "its bodies have no blendshapes"
        fail(file, "it marks no body parameters with ssilk:weightRange", there,
             "name the bodies, such as --family tall=1 heavy=1")  # fmt: skip
    alone, combined = bodies_within({name: (each.low, each.high) for name, each in marked.items()})
    told = f"{len(alone)} with one shape at an end of its range"
    told += f", and {len(combined)} with every shape at an end" if combined else ""
    report(Message(f"--family takes {format_count(len(alone + combined), 'bodies')} beside the stage's own: {told}"))
    return [f"{file}:{shapes}" for shapes in (*alone, *combined)]


def _as_compared(body: str) -> str:
    """Return where a body is with its weights of shapes as they are compared."""
    file, shapes = split_body(body)
    return f"{Path(file)}:{shapes_text(parse_shapes(body, shapes))}" if shapes else str(Path(body))


def named_bodies(stages: Sequence[Path]) -> dict[str, Path]:
    """Return the stages of bodies by their names, their stems or shapes; that of one alone by none.

    Raises:
        SsilkError: two have one name.
    """
    if len(stages) == 1:
        return {"": stages[0]}
    found: dict[str, Path] = {}
    for stage in stages:
        name = body_name(str(stage))
        if name in found:
            fail(str(stage), f"a second body '{name}'", "names of stages tell bodies apart", "rename one")
        found[name] = stage
    return found
