# SPDX-License-Identifier: Apache-2.0
"""What a finished task leaves beside its files, so that nobody bakes it again: bake.json."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from .. import __version__
from ..files import replacing, sha256
from .tasks import BakeTask

NAME = "bake.json"
INPUTS = ("model", "stage", "motion")  # where they lie makes no difference, what they hold does


@dataclass(frozen=True, kw_only=True)
class TaskRecord:
    """A finished task.

    Attributes:
        key: of everything that its files depend on (see `task_key`).
        files: SHA-256 of each file that it wrote, by path relative to the record's folder.
        detail: figures for people.
    """

    key: str
    files: dict[str, str]
    detail: dict[str, Any] = field(default_factory=dict)


def task_key(task: BakeTask, contents: Mapping[str, str]) -> str:
    """Return a hash of all that decides what a task writes.

    Args:
        contents: hashes of what is in each of its `INPUTS`.
    """
    options = {name: value for name, value in asdict(task).items() if name not in INPUTS}
    document = {"ssilk": __version__, "options": options, "contents": {name: contents[name] for name in INPUTS}}
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()


def write_record(folder: Path, record: TaskRecord) -> None:
    """Write a record into the folder of its files, last of all."""
    with replacing(folder / NAME, keep_same=True) as temporary:
        temporary.write_text(json.dumps(asdict(record), indent=1, sort_keys=True) + "\n")


def read_record(folder: Path) -> TaskRecord | None:
    """Return the record of a folder; None where there is none that can be read, so that its task is done again."""
    try:
        document = json.loads((folder / NAME).read_text())
        record = TaskRecord(**document)
        whole = isinstance(record.files, dict) and isinstance(record.detail, dict)
    except (OSError, ValueError, TypeError, RecursionError):
        return None
    return record if whole else None


def is_current(folder: Path, key: str) -> bool:
    """Return whether a task is done: its record has this key, and its files are as they were written."""
    record = read_record(folder)
    if record is None or record.key != key:
        return False
    return all(_same(folder / name, digest) for name, digest in record.files.items())


def _same(path: Path, digest: str) -> bool:
    return path.is_file() and sha256(path) == digest
