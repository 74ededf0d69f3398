# SPDX-License-Identifier: Apache-2.0
"""Names of garments and shots: of their files, by a pattern over their paths, or from a list."""

from __future__ import annotations

import hashlib
import json
import os
import re
import unicodedata
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ...errors import SsilkError, fail
from ...files import split_body, split_location
from ...scene.plain import from_plain
from ...scene.shape_weights import body_name
from .request import parse_range

FIELDS = "{stem}, {prim}, {parent}, {parent2}, {parent3}, ... are names of its file, prim and folders"
LONGEST = 100  # characters of a name; file systems take 255 bytes
_FIELD = re.compile(r"\{([^{}]*)\}")


def pattern_name(pattern: str, location: str, option: str) -> str:
    """Return the name that a pattern such as "{parent}_{stem}" gives "file[:/Prim]".

    Args:
        option: that gave the pattern, for messages.

    Raises:
        SsilkError: a field that does not exist, or that this path lacks.
    """
    file, prim = split_location(location)
    path = Path(os.path.abspath(split_body(file)[0]))
    fields = {"stem": body_name(file), "prim": (prim or "").rpartition("/")[2]}
    fields |= {f"parent{'' if up == 1 else up}": folder.name for up, folder in enumerate(path.parents, start=1)}

    def value(match: re.Match[str]) -> str:
        if not fields.get(match[1]):
            fail(f"{option} {pattern}", f"'{location}' has no {match[0]}", FIELDS)
        return fields[match[1]]

    return _FIELD.sub(value, pattern)


def location_stem(location: str) -> str:
    """Return the name of "file[:/Prim]" where none is given: the file's stem, and the prim's name."""
    file, prim = split_location(location)
    return Path(file).stem + (f"_{prim_leaf(prim)}" if prim else "")


def prim_leaf(path: str) -> str:
    """Return the last name of a prim's path."""
    return path.rstrip("/").rpartition("/")[2]


def file_name(text: str) -> str:
    """Return a name as that of a folder: of ASCII letters, digits, "_" and "-".

    USD takes other letters in names since version 24.03, and many readers are older. Names that lose letters keep
    apart by a hash. So do names that are cut because they are too long.
    """
    composed = unicodedata.normalize("NFC", text)  # file systems store letters with accents in either form
    bare = "".join(letter for letter in unicodedata.normalize("NFKD", text) if not unicodedata.combining(letter))
    name = re.sub(r"[^A-Za-z0-9_-]", "_", bare)
    if composed.isascii() and len(name) <= LONGEST:
        return name or "_"
    return f"{name.strip('_')[:LONGEST]}_{hashlib.sha256(composed.encode()).hexdigest()[:8]}"


def prim_name(text: str) -> str:
    """Return a name as that of a prim and of its folder: as `file_name`, without "-", and no digit in front."""
    return re.sub(r"^(?=\d)", "_", file_name(text).replace("-", "_"))


def need_unique(named: Iterable[tuple[str, str]], where: str, kind: str, option: str) -> None:
    """Raise `SsilkError` where two inputs have one name, or names that not every file system tells apart."""
    first: dict[str, tuple[str, str]] = {}
    for name, location in named:
        other, before = first.setdefault(name.casefold(), (name, location))
        if before != location:
            both = (
                f"the {kind} '{name}'" if other == name else f"the {kind}s '{other}' and '{name}', one on some disks"
            )
            fail(
                where,
                f"'{before}' and '{location}' would both be {both}",
                "files and folders are named by them",
                f"name them with {option}, such as {{parent}}_{{stem}}",
            )


@dataclass(frozen=True)
class ListedShot:
    """A shot: its motion, "file[:/Prim]", and its range as a request takes it."""

    motion: str
    range: str | None = None


def read_shots(path: Path) -> dict[str, ListedShot]:
    """Return the shots of a list by their names.

    Args:
        path: of a JSON file such as {"s010": "s010/anim.usdc"}, where paths are relative to the file. An entry may
            also be {"motion": "s010/anim.usdc", "range": "1021-1100"}.

    Raises:
        SsilkError: it cannot be read, or holds anything else.
    """
    allowed = ('a list of shots is JSON such as {"s010": "s010/anim.usdc", "s020": {"motion": "s020/anim.usdc", '
               '"range": "1001-1100"}}')  # fmt: skip
    if not path.is_file():
        fail(str(path), "there is no such file", allowed)
    try:
        document = json.loads(path.read_text(encoding="utf-8"), object_pairs_hook=_unique)
    except (ValueError, RecursionError) as error:
        fail(str(path), f"it cannot be read ({error})", allowed)
    if not (isinstance(document, Mapping) and document):
        fail(str(path), "it names no shots", allowed)
    return {str(name): _listed(path, str(name), entry, allowed) for name, entry in document.items()}


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the pairs of a JSON object; raise `ValueError` for a name that comes twice."""
    document: dict[str, Any] = {}
    for name, entry in pairs:
        if name in document:
            raise ValueError(f"'{name}' is there twice")
        document[name] = entry
    return document


def _listed(path: Path, name: str, entry: object, allowed: str) -> ListedShot:
    try:
        shot = from_plain(ListedShot, {"motion": entry} if isinstance(entry, str) else entry)
    except TypeError as error:
        fail(str(path), f"in the shot '{name}', {error}", allowed)
    if not (name.strip() and shot.motion):
        fail(str(path), f"the shot '{name}' has '{shot.motion}' for a motion", allowed)
    if shot.range is not None:
        try:
            parse_range(shot.range)
        except SsilkError as error:
            fail(str(path), f"the shot '{name}' has '{shot.range}' for a range", error.allowed)
    return replace(shot, motion=str(path.parent / shot.motion))
