# SPDX-License-Identifier: Apache-2.0
"""A job as a file: its tasks, which workers name by their numbers."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from .. import __version__
from ..bake import BakeTask
from ..bake.plain import from_plain
from ..errors import SsilkError, fail
from ..files import replacing

NAME = "job.json"


def write_job(path: str | Path, tasks: Sequence[BakeTask]) -> None:
    """Write the tasks of a job; raise `SsilkError` where that is not possible."""
    document = {"ssilk": __version__, "tasks": [asdict(task) for task in tasks]}
    with replacing(path, keep_same=True) as temporary:
        temporary.write_text(json.dumps(document, indent=1) + "\n")


def read_job(path: str | Path, mapping: str | Path | None = None) -> list[BakeTask]:
    """Return the tasks of a job.

    Args:
        mapping: a file with Open Job Description's rules for where another machine's paths lie on this one.

    Raises:
        SsilkError: a file is missing or damaged.
    """
    document = _json(Path(path), "a file written by 'ssilk farm' is needed")
    rules = _json(Path(mapping), "path mapping rules are needed").get("path_mapping_rules", []) if mapping else []
    try:
        tasks = [_checked(from_plain(BakeTask, entry)) for entry in document["tasks"]]
        return [_mapped(task, rules) for task in tasks]
    except (KeyError, TypeError, AttributeError, SsilkError) as error:
        fail(str(path), f"it is no job ({type(error).__name__}: {error})", "a file written by 'ssilk farm' is needed")


def _json(path: Path, allowed: str) -> dict[str, Any]:
    if not path.is_file():
        fail(str(path), "there is no such file", allowed)
    try:
        document = json.loads(path.read_text())
    except (ValueError, RecursionError) as error:
        fail(str(path), f"it is no JSON ({error})", allowed)
    if not isinstance(document, dict):
        fail(str(path), "it holds no names", allowed)
    return document


def _checked(task: BakeTask) -> BakeTask:
    """Return a task; raise `TypeError` where its names would lead to files elsewhere."""
    if not re.fullmatch(r"[A-Za-z_]\w*/[\w-]+", f"{task.garment}/{task.shot}", flags=re.ASCII):
        raise TypeError(f"{task.name!r} names no files")
    return task


def _mapped(task: BakeTask, rules: Iterable[dict[str, str]]) -> BakeTask:
    """Return a task with its inputs where they lie on this machine."""
    return replace(task, request=task.request.relocated(lambda path: _found(path, rules)))


def _found(path: str, rules: Iterable[dict[str, str]]) -> str:
    for rule in rules:
        kind = PureWindowsPath if rule["source_path_format"] == "WINDOWS" else PurePosixPath
        if kind(path).is_relative_to(rule["source_path"]):
            return str(Path(rule["destination_path"], *kind(path).relative_to(rule["source_path"]).parts))
    return path


def numbers(text: str, count: int) -> list[int]:
    """Return the numbers of tasks that a text such as "0-9,12" names.

    Args:
        count: how many tasks there are.

    Raises:
        SsilkError: it names none, or one that does not exist.
    """
    where, allowed = "--tasks", f"numbers from 0 to {count - 1} are needed, such as 0-9,12"
    found: list[int] = []
    for part in text.split(","):
        first, dash, last = part.partition("-")
        if not re.fullmatch(r"\s*\d{1,9}\s*(-\s*\d{1,9}\s*)?", part):
            fail(where, f"'{text}'", allowed)
        span = range(int(first), int(last if dash else first) + 1)
        if not (len(span) and span[-1] < count):
            fail(where, f"'{text}'", allowed)
        found += span
    return sorted(set(found))
