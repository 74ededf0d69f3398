# SPDX-License-Identifier: Apache-2.0
"""Splits of clips, as an index lists them: {"clip", "split", "tags"}."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ...errors import fail

SPLITS = ("valid", "test", "inertia", "flips")
ALLOWED = 'an index is a JSON list of {"clip": name, "split": name, "tags": [names]}'


@dataclass(frozen=True)
class ClipEntry:
    """A clip of an index."""

    clip: str
    split: str
    tags: tuple[str, ...] = ()


def read_index(path: Path) -> list[ClipEntry]:
    """Read an index.

    Raises:
        SsilkError: there is none, or it is malformed.
    """
    if not path.is_file():
        fail(str(path), "there is no such file", ALLOWED)
    try:
        document = json.loads(path.read_text())
        return [
            ClipEntry(_text(item["clip"]), _text(item["split"]), tuple(item.get("tags", ()))) for item in document
        ]
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        fail(str(path), f"no index of clips ({type(error).__name__}: {error})", ALLOWED)


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is no name")
    return value


def chosen(index: Sequence[ClipEntry], split: str) -> list[str]:
    """Return the clips of a split, or those of `valid` with a tag."""
    return [e.clip for e in index if e.split == split or (e.split == "valid" and split in e.tags)]


def splits_of(index: Sequence[ClipEntry], clips: Sequence[str] = ()) -> dict[str, list[str]]:
    """Return the clips of each of `SPLITS` that has any, only those of `clips` where some are given."""
    names = {split: [clip for clip in chosen(index, split) if not clips or clip in clips] for split in SPLITS}
    return {split: found for split, found in names.items() if found}
