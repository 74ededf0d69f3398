# SPDX-License-Identifier: Apache-2.0
"""A job as a file: its tasks, which workers name by their numbers."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, NoReturn

from ... import __version__
from ...errors import SsilkError, fail
from ...events import Message, Reporter
from ...files import replacing
from ...scene.plain import from_plain
from ..bake import BakeRequest, BakeTask
from ..bake.asked import tell_impossible
from ..bake.inputs import InputContents, InputFiles, InputHashes, shapes_of
from ..bake.layered import in_levels

NAME = "job.json"


@dataclass(frozen=True)
class FarmJob:
    """Tasks, and what their inputs held when they were submitted, by the inputs' locations."""

    tasks: tuple[BakeTask, ...]
    inputs: Mapping[str, InputContents]


def submitted(tasks: Sequence[BakeTask], report: Reporter) -> FarmJob:
    """Return tasks pinned to what their inputs hold now, so that nobody bakes other files that come in their place.

    Those that are certified over others come after these, as the steps of a bundle count them. A task with an input
    that cannot be read, or that has not what is asked of it, is kept, with a warning: it fails alone until the job is
    submitted again.

    Raises:
        SsilkError: no task is left that can be baked, because an input cannot be read, or lacks what is asked of it
            (`tell_impossible`).
    """
    files = InputFiles()
    found: dict[str, InputContents] = {}
    unread: list[SsilkError] = []
    for name, path in dict.fromkeys(item for task in tasks for item in task.request.inputs.items()):
        try:
            found[path] = files.contents(name, path)
        except SsilkError as error:
            unread.append(error)
    able = any(found.keys() >= set(task.request.inputs.values()) for task in tasks)
    for fault in unread if able else unread[:-1]:
        report(Message(str(fault), "warning"))
    if not able:
        raise unread[-1]
    tell_impossible(tasks, found, report)
    return FarmJob(tuple(_pinned(task, found) for level in in_levels(tasks) for task in level), found)


def write_job(path: str | Path, job: FarmJob) -> None:
    """Write a job, a line for each task; raise `SsilkError` where that is not possible."""
    lines = ",\n".join(json.dumps(_entry(task)) for task in job.tasks)
    inputs = {path: dict(held.files) for path, held in job.inputs.items()}
    head = json.dumps({"ssilk": __version__, "inputs": inputs}, indent=1).removesuffix("\n}")
    with replacing(path, keep_same=True) as temporary:
        temporary.write_text(f'{head},\n "tasks": [\n{lines}\n]}}\n')


def is_job(path: Path) -> bool:
    """Return whether a file begins as `write_job` begins one."""
    head = b'{\n "ssilk": '
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        return stream.read(len(head)) == head


def _entry(task: BakeTask) -> dict[str, Any]:
    """Return what differs from the defaults: a job of 50,000 tasks is read by each chunk."""
    stated = {**_stated(task), "request": _stated(task.request)}
    stated.pop("pinned", None)
    return stated


def _stated(values: BakeTask | BakeRequest) -> dict[str, Any]:
    return {item.name: value for item in fields(values) if (value := getattr(values, item.name)) != item.default}


def read_job(path: str | Path, mapping: str | Path | None = None, chosen: str | None = None) -> FarmJob:
    """Return a job, or some of its tasks.

    Args:
        mapping: a file with Open Job Description's rules for where another machine's paths lie on this one.
        chosen: numbers of the tasks, such as "0-9,12"; None for all.

    Raises:
        SsilkError: a file is missing or damaged, or there are no such tasks.
    """
    document = _json(Path(path), "a file written by 'ssilk farm' is needed")
    rules = _json(Path(mapping), "path mapping rules are needed").get("path_mapping_rules", []) if mapping else []
    entries = document.get("tasks")
    if not isinstance(entries, list):
        _no_job(path, "it is no job (it has no tasks)")
    wanted = range(len(entries)) if chosen is None else numbers(chosen, len(entries))
    try:
        tasks = [_mapped(_checked(from_plain(BakeTask, entries[number])), rules) for number in wanted]
        held = document.get("inputs", {})
        inputs = {_found(path, rules): _contents(path, files, rules) for path, files in held.items()}
        return FarmJob(tuple(_pinned(task, inputs) for task in tasks), inputs)
    except (KeyError, TypeError, AttributeError, SsilkError) as error:
        return _no_job(path, f"it is no job ({type(error).__name__}: {error})")


def _no_job(path: str | Path, found: str) -> NoReturn:
    fail(str(path), found, "a file written by 'ssilk farm' is needed")


def _contents(location: str, files: Mapping[str, str], rules: Sequence[dict[str, str]]) -> InputContents:
    if not files or not all(isinstance(digest, str) for digest in files.values()):
        raise TypeError(f"{str(files)[:40]!r} are no files with their hashes")
    held = tuple((_found(path, rules), digest) for path, digest in files.items())
    return InputContents(held, shapes_of(location))


def _pinned(task: BakeTask, inputs: Mapping[str, InputContents]) -> BakeTask:
    """Return a task with what its inputs held when the job was submitted; a job without inputs pins nothing."""
    held = {name: inputs[path].digest if path in inputs else "" for name, path in task.request.inputs.items()}
    return replace(task, pinned=InputHashes(**held)) if inputs else task


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
    names = (task.garment, task.level_of or task.garment, *task.over)
    if not all(re.fullmatch(r"[A-Za-z_]\w*/[\w-]+", f"{name}/{task.shot}", flags=re.ASCII) for name in names):
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
    where, allowed = "--tasks", f"numbers from 0 to {count - 1} are needed, such as 0-{count - 1}"
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
