# SPDX-License-Identifier: Apache-2.0
"""Read wardrobe lists: TOML files with defaults and one table for each garment to train."""

from __future__ import annotations

import json
import os
import re
import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ...errors import did_you_mean, fail, fail_unknown
from ...files import relative_path, replacing, split_location
from ...scene.fabrics import FABRICS
from ...scene.shape_weights import is_shapes
from ..settings import PRESETS

DEFAULTS = "defaults"  # the table whose keys every garment inherits
TABLES = ("material", "set")  # keys whose values are merged with those of the defaults


@dataclass(frozen=True)
class WardrobeEntry:
    """A garment of a list.

    Attributes:
        words: its arguments for 'ssilk train', without the garments of the list that it is worn over.
        over: names of these.
        table: its keys and those that it inherits, as the list has them.
    """

    name: str
    words: tuple[str, ...]
    over: tuple[str, ...] = ()
    table: Mapping[str, Any] = field(default_factory=dict, compare=False)

    def located(self, folder: Path) -> dict[str, Any]:
        """Return the table with its paths as seen from here; `folder` is that of the list."""
        return {key: _relocated(key, value, lambda path: str(folder / path)) for key, value in self.table.items()}

    def models(self, table: Mapping[str, Any]) -> list[str]:
        """Return the model files among what `located` says that it is worn over."""
        return [inner for inner in table.get("over", ()) if inner.endswith(MODEL)]


@dataclass(frozen=True)
class Key:
    """Allowed values of a key, and its option of 'ssilk train'; "" for a positional argument.

    Attributes:
        names: all allowed values, where these are names.
    """

    option: str
    fits: Callable[[Any], bool]
    allowed: str
    names: tuple[str, ...] = ()

    @classmethod
    def one_of(cls, option: str, names: Iterable[str]) -> Key:
        """Return the key whose value is one of some names."""
        known = tuple(names)
        return cls(option, lambda value: value in known, f"one of {', '.join(known)}", known)


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and value != ""


def _is_texts(value: Any) -> bool:
    return _is_text(value) or (isinstance(value, list) and value != [] and all(map(_is_text, value)))


def _is_scalars(value: Any) -> bool:
    return isinstance(value, dict) and all(isinstance(item, str | int | float | list) for item in value.values())


def _is_range(value: Any) -> bool:
    return isinstance(value, list) and all(_is_text(item) or type(item) in (int, float) for item in value)


KEYS = {
    "stage": Key("", _is_text, "the path of a stage"),
    "garment": Key("--garment", _is_text, "a path, a path:/prim or a prim"),
    "motions": Key("--motions", _is_texts, "a path or a list of paths"),
    "valid": Key("--valid", _is_texts, "a path or a list of paths"),
    "preset": Key.one_of("--preset", PRESETS),
    "fabric": Key.one_of("--fabric", FABRICS),
    "material": Key("--material", _is_scalars, "a table of values, like { drag = 0.3 },"),
    "fabrics": Key("--fabrics", _is_range, "a list of presets and factors, like ['silk', 4],"),
    "set": Key("--set", _is_scalars, "a table of values, like { iterations = 20000 },"),
    "family": Key("--family", lambda value: value is True or _is_texts(value), "true, or a list of bodies,"),
    "graded": Key("--graded", lambda value: isinstance(value, bool), "true or false"),
    "over": Key("--over", lambda value: isinstance(value, list) and all(map(_is_text, value)), 'a list, like ["a"],'),
}
USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
MODEL = ".safetensors"  # what 'over' names that ends so is a file; all else is a garment of the list
NEEDED = ("stage", "motions")


def read_list(path: Path) -> list[WardrobeEntry]:
    """Read the garments of a list, inner ones before those that are worn over them, else in its own order.

    Paths in it are relative to its folder.

    Raises:
        SsilkError: the file is missing or not TOML, or an entry is wrong.
    """
    if not path.is_file():
        fail(str(path), "there is no such file", "a TOML file with one table for each garment is needed")
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        fail(str(path), f"not a TOML file ({error})", "a list holds one table for each garment")
    for name, table in tables.items():
        _need_table(path, name, table)
    defaults = tables.pop(DEFAULTS, {})
    if not tables:
        fail(str(path), "no garment in it", "a list holds one table for each garment", "add [name]")
    for name, table in tables.items():
        if name in table.get("over", ()):  # in [defaults], which all inherit, it stands for all but itself
            found, allowed = "it names itself", "garments beneath it are named"
            fail(f"{path}: table '{name}', key 'over'", found, allowed, "remove its own name")
    entries = [_entry(path, name, _joined(defaults, table)) for name, table in tables.items()]
    for entry in entries:
        for inner in entry.over:
            if inner not in tables:
                fail_unknown(f"{path}: table '{entry.name}', key 'over'", "no such garment", inner, tables)
    return _in_order(path, entries)


def write_list(path: Path, tables: Mapping[str, Mapping[str, Any]]) -> None:
    """Write a list of garments, from tables whose paths are as seen from here.

    Raises:
        SsilkError: the file cannot be written.
    """
    here = path.absolute().parent

    def moved(location: str) -> str:
        return relative_path(location, here) or os.path.abspath(location)

    lines = list[str]()
    for name, table in tables.items():
        said = {key: _relocated(key, value, moved) for key, value in table.items()}
        lines += [f"[{_key(name)}]", *(f"{key} = {_toml(value)}" for key, value in said.items() if value != {}), ""]
    with replacing(path) as half_done:
        half_done.write_text("\n".join(lines), encoding="utf-8")


def garment_file(table: Mapping[str, Any]) -> tuple[str, str | None]:
    """Return the file with the garment of a table, and the prim that the table names in it."""
    file, prim = split_location(str(table.get("garment", "")))
    return (file, prim) if file.endswith(USD_SUFFIXES) else (str(table["stage"]), table.get("garment"))


def _relocated(key: str, value: Any, move: Callable[[str], str]) -> Any:
    """Return the value of a key with other paths."""
    if key == "stage":
        return move(value)
    if key == "garment":
        file, prim = split_location(value)
        own = file.endswith(USD_SUFFIXES)
        return (f"{move(file)}:{prim}" if prim else move(file)) if own else value
    if key == "family" and value is True:
        return value
    if key in ("motions", "valid", "family"):
        listed = [value] if isinstance(value, str) else value
        return [each if key == "family" and is_shapes(each) else move(each) for each in listed]
    return [move(each) if each.endswith(MODEL) else each for each in value] if key == "over" else value


def _key(name: str) -> str:
    """Return a key as TOML has it."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _toml(name)


def _toml(value: Any) -> str:
    """Return a value of a list as TOML, whose strings are JSON's."""
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{_key(name)} = {_toml(item)}' for name, item in value.items())} }}"
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _entry(path: Path, name: str, table: dict[str, Any]) -> WardrobeEntry:
    over = [inner for inner in table.get("over", ()) if inner != name]  # of [defaults], which all inherit
    files = [inner for inner in over if inner.endswith(MODEL)]
    words = _words(path, name, {key: value for key, value in table.items() if key != "over"})
    given = tuple(word for file in files for word in ("--over", file))
    return WardrobeEntry(name, words + given, tuple(inner for inner in over if inner not in files), table)


def _in_order(path: Path, entries: list[WardrobeEntry]) -> list[WardrobeEntry]:
    """Return entries after those that they are worn over; raise `SsilkError` where they are over one another."""
    left, found = list(entries), list[WardrobeEntry]()
    while left:
        done = {entry.name for entry in found}
        ready = next((entry for entry in left if set(entry.over) <= done), None)
        if ready is None:
            names = ", ".join(entry.name for entry in left)
            allowed = "of two garments one is the inner one"
            fail(f"{path}: key 'over'", f"{names} are worn over one another", allowed, "remove one of these")
        found.append(ready)
        left.remove(ready)
    return found


def _need_table(path: Path, name: str, table: Any) -> None:
    """Raise `SsilkError` unless a name is a valid file name and its table has known keys with valid values."""
    if not isinstance(table, dict):
        fail(
            f"{path}: key '{name}'",
            "it belongs to no table",
            f"each key belongs to [{DEFAULTS}] or to the table of a garment",
        )
    if not re.fullmatch(r"\w[\w.-]*", name):
        fail(
            f"{path}: table '{name}'",
            "its name would be the name of files",
            "letters, digits, '_', '-' and '.' are allowed",
        )
    for key, value in table.items():
        where = f"{path}: table '{name}', key '{key}'"
        if key not in KEYS:
            fail_unknown(where, "no such key", key, KEYS)
        if not KEYS[key].fits(value):
            near = did_you_mean(value, KEYS[key].names) if isinstance(value, str) else ""
            fail(where, f"{value!r}", f"{KEYS[key].allowed} is needed", near)


def _joined(defaults: dict[str, Any], table: dict[str, Any]) -> dict[str, Any]:
    both = {key: {**defaults.get(key, {}), **table.get(key, {})} for key in TABLES}
    return {**defaults, **table, **both}


def _words(path: Path, name: str, table: dict[str, Any]) -> tuple[str, ...]:
    for key in NEEDED:
        if key not in table:
            fail(f"{path}: table '{name}', key '{key}'", "missing", f"it is needed here or in [{DEFAULTS}]")
    said = [(key.option, table[name]) for name, key in KEYS.items() if name in table]
    return tuple(word for option, value in said for word in _option(option, value))


def _option(option: str, value: Any) -> list[str]:
    """Return an option and its value as command-line arguments."""
    if isinstance(value, bool):
        return [option] if value else []
    if isinstance(value, dict):
        return [word for name, item in value.items() for word in (option, f"{name}={_text(item)}")]
    return [*filter(None, [option]), *map(str, value if isinstance(value, list) else [value])]


def _text(value: Any) -> str:
    """Format a value for "name=value"."""
    if isinstance(value, bool):
        return str(value).lower()
    return ",".join(map(str, value)) if isinstance(value, list) else str(value)
