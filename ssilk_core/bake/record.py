# SPDX-License-Identifier: Apache-2.0
"""What a finished task leaves beside its files, so that nobody bakes it again: bake.json."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from .. import __version__, work_record
from ..errors import SsilkError
from ..files import sha256
from ..work_record import Hash, WorkRecord, request_key
from .inputs import InputHashes
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


def task_key(task: BakeTask, contents: InputHashes) -> str:
    """Return a hash of all that decides what a task writes: where its inputs lie makes no difference.

    Args:
        contents: what the request's inputs hold.
    """
    options = asdict(task)
    del options["pinned"]
    for name in INPUTS:
        del options["request"][name]
    return request_key({"ssilk": __version__, "options": options}, [*asdict(contents).items()])


def write_record(folder: Path, record: TaskRecord) -> None:
    """Write a record into the folder of its files, last of all."""
    written = WorkRecord(key=record.key, files=dict(record.files), detail=_portable(record.result))
    work_record.write_record(folder / RECORD, written)


def _portable(result: BakeResult) -> dict[str, object]:
    """Return a result without its folder, which can move."""
    return {**asdict(result), "path": result.path.name}


def read_record(folder: Path) -> TaskRecord | None:
    """Return the record of a folder; None where none can be read, so that its task is done again."""
    try:
        found = work_record.read_record(folder / RECORD)
        if found is None:
            return None
        result = from_plain(BakeResult, {**found.detail, "path": folder / found.detail["path"]})
        return TaskRecord(key=found.key, files=found.files, result=result)
    except (SsilkError, ValueError, TypeError, KeyError):
        return None


def current_record(folder: Path, key: str, hashed: Hash = sha256) -> TaskRecord | None:
    """Return the record of a task that is done: it has this key, and the files are as they were written.

    Args:
        hashed: gives the SHA-256 of a file.
    """
    record = read_record(folder)
    if record is None or record.key != key:
        return None
    return record if WorkRecord(key=key, files=record.files).is_done(folder, hashed) else None
