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


def read_member(
    options: argparse.Namespace, location: str, first: Character, report: Reporter, root: str | None = None
) -> Character:
    """Read another body of the first character; its stage may have that one's garment too, which is no body.

    It may lack what --body leaves out, which is told.
    """
    from ssilk_usd.reading.character import WITHOUT, bodies_there, read_character

    file, prim = garment_location(options)
    stage, root = split_body(str(options.stage))[0], root or options.root
    worn = prim if is_same_file(file, stage) else None
    own = worn if is_same_file(split_body(location)[0], stage) else None
    kept = {body.mesh.path.rpartition("/")[2] for body in (*first.bodies, *first.stand_ins)}
    asked = [*options.body, *([f"{WITHOUT}{worn}"] if worn else [])]
    there = {name: bodies_there(location, [name], kept, root=root, garment=own) for name in asked}
    bodies = [each for found in there.values() for each in found]
    member = read_character(location, root=root, bodies=bodies, garment=own, report=report)
    if missing := [name.removeprefix(WITHOUT) for name in dict.fromkeys(options.body) if not there[name]]:
        count = ", ".join(body.mesh.path.rpartition("/")[2] for body in (*member.bodies, *member.stand_ins))
        text = f"there is no {' and no '.join(missing)} to leave out with --body"
        report(Message(f"{member.path}: {text}; what counts as its body is {count or 'no mesh'}"))
    return member


def left_out_in_list(entry: WardrobeEntry, entries: Sequence[WardrobeEntry], folder: Path) -> dict[str, list[str]]:
    """Return what --body leaves out of the bodies that a garment of a list meets, by the tables that it is of.

    Garments that a stage does not mark as such count as bodies: another of the list would be met as one, which moves
    with the skeleton. Tables whose garments count as none are left out.

    Args:
        folder: that of the list, to which its paths are relative.

    Raises:
        SsilkError: the stage has no character.
    """
    from ssilk_usd.reading.character import WITHOUT, unmarked_garments

    from ...training.wardrobe.listing import garment_file

    table = entry.located(folder)
    stage, (garment, own) = str(table["stage"]), garment_file(table)
    file = split_body(stage)[0]
    if not Path(file).is_file():
        return {}  # which is told where it is read
    places = {each.name: garment_file(each.located(folder)) for each in entries if each is not entry}
    beside = {name: prim for name, (other, prim) in places.items() if prim and is_same_file(other, file)}
    if not beside:
        return {}
    found = unmarked_garments(stage, [*beside.values()], own if is_same_file(garment, file) else None)
    return {name: [f"{WITHOUT}{path}" for path in found[prim]] for name, prim in beside.items() if found[prim]}


def bodies_in_list(
    entry: WardrobeEntry, entries: Sequence[WardrobeEntry], folder: Path, report: Reporter
) -> list[str]:
    """Return --body for a garment of a list, as `left_out_in_list`; tell which it does not meet as a garment either.

    Raises:
        SsilkError: the stage has no character.
    """
    left_out = left_out_in_list(entry, entries, folder)
    beside = [each for each in entries if each.name in left_out]
    # Whose models 'over' names is not known here.
    sure = [] if entry.models(entry.table) else [each for each in beside if not each.models(each.table)]
    if unmet := [each.name for each in sure if each.name not in entry.over and entry.name not in each.over]:
        text = f"{entry.name} does not meet {', '.join(unmet)}: meshes of its stage that are garments of the list"
        report(Message(f"{text} are no bodies; where one is worn over the other, say so with 'over'"))
    return [*dict.fromkeys(each for paths in left_out.values() for each in paths)]


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
