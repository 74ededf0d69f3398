# SPDX-License-Identifier: Apache-2.0
"""Inspect the garments of a list as 'ssilk inspect' does one, each over the garments that it is worn over."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..errors import fail
from ..events import Reporter, Result
from ..files import need_not_input
from ..training.wardrobe.listing import WardrobeEntry, garment_file, read_list, write_list
from ._inspected import Inspected
from .options.bodies import bodies_in_list

OF_A_GARMENT = ("garment", "root", "body", "over", "family")  # options that a list has no use for


def inspect_list(
    options: argparse.Namespace, report: Reporter, inspect: Callable[[argparse.Namespace, Reporter], Inspected]
) -> int:
    """Inspect each garment of the list in place of the stage; return the worst exit code.

    Where repaired copies are asked for, each is over the copies of those beneath it, and the list is copied last.

    Args:
        inspect: one garment, by the options that say which.
    """
    for name in OF_A_GARMENT:
        if getattr(options, name):
            fail(f"--{name}", f"{options.stage} is a list", "its tables say what each garment is", "leave it out")
    folder, entries = options.stage.parent, read_list(options.stage)
    copy = _need_folder(options.fix, options.stage) if options.fix else None
    if copy:
        _need_no_inputs(copy.parent, [(entry.name, entry.located(folder)) for entry in entries], options.motion)
    tables: dict[str, dict[str, Any]] = {}
    found: dict[str, Inspected] = {}
    for entry in entries:
        table = tables[entry.name] = entry.located(folder)
        own = _options_of(entry, table, tables, options)
        own.body = bodies_in_list(entry, entries, folder, report)
        if copy:
            prim = _garment_in(table)[1]
            own.fix = _copy_in(copy.parent, entry.name)
            table["garment"] = f"{own.fix}:{prim}" if prim else str(own.fix)
        found[entry.name] = inspect(own, report)
        if not options.json:
            over = f", over {', '.join(entry.over)}" if entry.over else ""
            print(f"== {entry.name}{over}", "", found[entry.name].text(own.fix), "", sep="\n")
    if copy:
        write_list(copy, tables)
    if options.json:
        every = {name: each.detail(None) | {"repaired": each.repaired or []} for name, each in found.items()}
        report(Result("inspect", {"garments": every, **({"fixed": str(copy)} if copy else {})}))
    elif copy:
        print(f"{copy}: the list of these copies")
    return max(each.code for each in found.values())


def _need_folder(folder: Path, path: Path) -> Path:
    """Return where the copy of a list goes; raise `SsilkError` unless a folder is named that is not its own."""
    if folder.suffix or folder.is_file():
        fail(str(folder), "a file", "the repaired copies of a list's garments go into a folder", "name a folder")
    if folder.exists() and folder.samefile(path.absolute().parent):
        fail(str(folder), "this is the folder of the list", "--fix writes copies", "name another folder")
    folder.mkdir(parents=True, exist_ok=True)
    return folder / path.name


def _copy_in(folder: Path, name: str) -> Path:
    return folder / f"{name}.usdc"


def _need_no_inputs(folder: Path, tables: Sequence[tuple[str, Mapping[str, Any]]], motions: Sequence[Path]) -> None:
    """Raise `SsilkError` where a copy would replace what a garment of a list is read from, before one is written."""
    inputs = [*motions]
    for _, table in tables:
        clips = [*_listed(table, "motions"), *_listed(table, "valid")]
        inputs += map(Path, (table["stage"], garment_file(table)[0], *clips))
    for name, _ in tables:
        need_not_input(_copy_in(folder, name), *inputs)


def _listed(table: Mapping[str, Any], key: str) -> list[str]:
    value = table.get(key, [])
    return value if isinstance(value, list) else [value]


def _options_of(
    entry: WardrobeEntry,
    table: Mapping[str, Any],
    tables: Mapping[str, Mapping[str, Any]],
    options: argparse.Namespace,
) -> argparse.Namespace:
    """Return the options that inspect a garment of a list."""
    return argparse.Namespace(**{
        **vars(options),
        "stage": Path(table["stage"]),
        "garment": table.get("garment"),
        "motion": [*options.motion, *map(Path, _listed(table, "motions"))],
        "family": _family(table),
        "preset": options.preset or table.get("preset"),
        "over": [*(_location(tables[name]) for name in entry.over), *entry.models(table)],
        "over_names": [*entry.over, *_model_names(entry, entry.models(table))],
    })  # fmt: skip


def _family(table: Mapping[str, Any]) -> list[Path] | None:
    """Return the bodies of --family as its option has them."""
    if "family" not in table:
        return None
    return [] if table["family"] is True else [*map(Path, _listed(table, "family"))]


def _model_names(entry: WardrobeEntry, models: Sequence[str]) -> list[str]:
    """Return what findings call model files beneath a garment: as trainings do, their folders where names recur."""
    stems = [*entry.over, *(Path(model).stem for model in models)]
    paths = [Path(model).absolute() for model in models]
    return [path.parent.name if stems.count(path.stem) > 1 else path.stem for path in paths]


def _location(table: Mapping[str, Any]) -> str:
    """Return "file[:/Prim]" of the garment of a table."""
    file, prim = _garment_in(table)
    return f"{file}:{prim}" if prim else file


def _garment_in(table: Mapping[str, Any]) -> tuple[str, str | None]:
    """Return what `garment_file` does, with the path of a prim that is named: names stand behind no file."""
    from ssilk_usd.opening.stage import open_stage
    from ssilk_usd.reading.garment import find_garment

    file, prim = garment_file(table)
    if prim is None or prim.startswith("/"):
        return file, prim
    stage = open_stage(file)  # prims live as long as it
    return file, str(find_garment(stage, prim).GetPath())
