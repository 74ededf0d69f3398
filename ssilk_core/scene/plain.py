# SPDX-License-Identifier: Apache-2.0
"""Frozen dataclasses from the plain values of JSON and of USD's metadata, with their types checked."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from types import UnionType
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

T = TypeVar("T")


class OtherFieldsError(TypeError):
    """A document has other fields than its dataclass: perhaps another version wrote it."""


def from_plain(kind: type[T], document: object, *, figures: bool = False) -> T:
    """Return a dataclass of the values that `dataclasses.asdict` made of one.

    Args:
        figures: as measurements are kept. No field may be missing, whatever its default: it was not measured then. A
            number that is null was not finite, and becomes NaN.

    Raises:
        OtherFieldsError: a field is unknown, of `figures` missing, or a plain value where it has fields now.
        TypeError: a field without a default is missing, or one is of another type.
        SsilkError: the dataclass refuses a value.
    """
    return _dataclass(kind, "", document, figures)


def _dataclass(kind: type[T], inside: str, document: object, figures: bool) -> T:
    """Return a dataclass; messages put the name of the field that it is `inside`, with a dot, before its own."""
    if not isinstance(document, Mapping):
        found = f"{str(document)[:40]!r} has no fields"
        raise OtherFieldsError(f"{inside.rstrip('.')!r}, {found}") if inside else TypeError(found)
    types = _types(kind)  # type: ignore[arg-type]
    known = {item.name for item in fields(kind)}  # type: ignore[arg-type]
    unknown = sorted(str(name) for name in document.keys() - known)
    if unknown:
        raise OtherFieldsError(f"{inside + unknown[0]!r} is no field")
    missing = sorted(known - document.keys()) if figures else ()
    if missing:
        raise OtherFieldsError(f"{inside + missing[0]!r} is missing")
    return kind(**{name: _value(types[name], inside + name, value, figures) for name, value in document.items()})


@cache
def _types(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)


def _value(kind: Any, name: str, value: object, figures: bool) -> Any:
    """Return a plain value as `kind`: a dataclass, a tuple or dictionary, a union, a literal, or a plain type."""
    if get_origin(kind) is UnionType:
        if value is None and type(None) in get_args(kind):
            return None
        (kind,) = (each for each in get_args(kind) if each is not type(None))
    if get_origin(kind) is tuple and isinstance(value, list | tuple):
        return tuple(_value(get_args(kind)[0], name, item, figures) for item in value)
    if get_origin(kind) is dict and isinstance(value, Mapping):
        return {str(key): _value(get_args(kind)[1], f"{name}.{key}", item, figures) for key, item in value.items()}
    if is_dataclass(kind):
        return _dataclass(kind, f"{name}.", value, figures)  # type: ignore[arg-type]
    if value is None and kind is float and figures:
        return math.nan
    if get_origin(kind) is Literal:
        if value in get_args(kind):
            return value
    elif (
        get_origin(kind) is None  # tuples and dictionaries are returned by now
        and isinstance(value, kind if kind is not float else (int, float))
        and isinstance(value, bool) == (kind is bool)
    ):
        return value
    raise TypeError(f"{name!r} is {str(value)[:40]!r}")
