# SPDX-License-Identifier: Apache-2.0
"""What a folder of trained garments remembers of each: what was asked, how long it took, how it ended."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ..errors import fail
from ..files import replacing, sha256


@dataclass(frozen=True)
class TrainingRecord:
    """One garment's training.

    Attributes:
        asked: hash of the command and of the files that it reads.
        seconds: time spent so far [s].
        result: what 'ssilk train' reported when it had finished; None until then.
    """

    asked: str
    seconds: float = 0.0
    result: dict[str, Any] | None = None


def request_hash(words: Iterable[str], files: Iterable[Path]) -> str:
    """Return a hash of a command and of the content of the files that it reads."""
    document = [list(words), [[path.name, sha256(path)] for path in files]]
    return hashlib.sha256(json.dumps(document).encode()).hexdigest()


def load_record(path: Path) -> TrainingRecord | None:
    """Return a record, or None where there is none.

    Raises:
        SsilkError: the file is damaged.
    """
    if not path.exists():
        return None
    try:
        return TrainingRecord(**json.loads(path.read_text(encoding="utf-8")))
    except (ValueError, TypeError) as error:
        fail(str(path), f"the record of a training is damaged ({error})", "it says what is trained already",
             "delete it to train again")  # fmt: skip


def save_record(path: Path, record: TrainingRecord) -> None:
    """Write a record."""
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(asdict(record), indent=1) + "\n", encoding="utf-8")
