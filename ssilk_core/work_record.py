# SPDX-License-Identifier: Apache-2.0
"""Records of finished work beside its files: the request and the results, so that nothing is done twice."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from .errors import fail
from .files import replacing, sha256

Hash = Callable[[Path], str]


@dataclass(frozen=True, kw_only=True)
class WorkRecord:
    """A piece of work, begun or finished.

    Attributes:
        key: hash of all that its files depend on (see `request_key`).
        files: SHA-256 of each file that it wrote, by path relative to the record's folder; none until it is finished.
        detail: figures for people, as plain values.
    """

    key: str
    files: Mapping[str, str] = field(default_factory=dict)
    detail: Mapping[str, Any] = field(default_factory=dict)

    def is_done(self, folder: Path, hashed: Hash = sha256) -> bool:
        """Return whether the work is finished and its files in `folder` are as it wrote them.

        Args:
            hashed: gives the SHA-256 of a file.
        """
        return bool(self.files) and all(is_file(folder / name, digest, hashed) for name, digest in self.files.items())


def is_file(path: Path, digest: str, hashed: Hash = sha256) -> bool:
    """Return whether there is a file with these contents."""
    try:
        return hashed(path) == digest
    except OSError:
        return False


def request_key(asked: object, contents: Iterable[tuple[str, str]]) -> str:
    """Return a hash of a request.

    Args:
        asked: plain values that decide what is written.
        contents: name and SHA-256 of each input; where inputs lie makes no difference.
    """
    document = {"asked": asked, "contents": [*contents]}
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()


def write_record(path: Path, record: WorkRecord) -> None:
    """Write a record; after the files that it lists. Raise `SsilkError` where that is not possible."""
    with replacing(path, keep_same=True) as temporary:
        temporary.write_text(json.dumps(asdict(record), indent=1, sort_keys=True) + "\n", encoding="utf-8")


def read_record(path: Path) -> WorkRecord | None:
    """Return a record, or None where there is none.

    Raises:
        SsilkError: the file is damaged.
    """
    if not path.exists():
        return None
    try:
        record = WorkRecord(**json.loads(path.read_text(encoding="utf-8")))
        if isinstance(record.key, str) and isinstance(record.files, dict) and isinstance(record.detail, dict):
            return record
        found = "a value of another type"
    except (OSError, ValueError, TypeError, RecursionError) as error:
        found = str(error)
    return fail(
        str(path),
        f"this record of finished work is damaged ({found})",
        "it says what need not be done again",
        "delete it to do the work again",
    )
