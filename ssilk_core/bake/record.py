# SPDX-License-Identifier: Apache-2.0
"""What a finished task leaves beside its files, so that nobody bakes it again: bake.json."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from .. import __version__
from ..files import replacing, sha256
from .plain import from_plain
from .request import INPUTS
from .result import BakeResult
from .task import BakeTask

RECORD = "bake.json"


@dataclass(frozen=True, kw_only=True)
class TaskRecord:
    """A finished task.

    Attributes:
        key: of everything that its files depend on (see `task_key`).
        files: SHA-256 of each file that it wrote, by path relative to the record's folder.
        result: of its bake.
    """

    key: str
    files: Mapping[str, str]
    result: BakeResult


def task_key(task: BakeTask, contents: Mapping[str, str]) -> str:
    """Return a hash of all that decides what a task writes: where its inputs lie makes no difference.

    Args:
        contents: hashes of what is in each of the request's `INPUTS`.
    """
    options = asdict(task)
    for name in INPUTS:
        del options["request"][name]
    document = {"ssilk": __version__, "options": options, "contents": {name: contents[name] for name in INPUTS}}
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()


def write_record(folder: Path, record: TaskRecord) -> None:
    """Write a record into the folder of its files, last of all."""
    document = {"key": record.key, "files": dict(record.files), "result": _portable(record.result)}
    with replacing(folder / RECORD, keep_same=True) as temporary:
        temporary.write_text(json.dumps(document, indent=1, sort_keys=True) + "\n")


def _portable(result: BakeResult) -> dict[str, object]:
    """Return a result without its folder, which can move."""
    return {**asdict(result), "path": result.path.name}


def read_record(folder: Path) -> TaskRecord | None:
    """Return the record of a folder; None where none can be read, so that its task is done again."""
    try:
        document = json.loads((folder / RECORD).read_text())
        stored = document["result"]
        result = from_plain(BakeResult, {**stored, "path": folder / stored["path"]})
        return TaskRecord(key=document["key"], files=dict(document["files"]), result=result)
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return None


def current_record(folder: Path, key: str) -> TaskRecord | None:
    """Return the record of a task that is done: it has this key, and the files are as they were written."""
    record = read_record(folder)
    if record is None or record.key != key:
        return None
    same = all(_same(folder / name, digest) for name, digest in record.files.items())
    return record if same else None


def _same(path: Path, digest: str) -> bool:
    return path.is_file() and sha256(path) == digest
