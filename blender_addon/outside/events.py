# SPDX-License-Identifier: GPL-3.0-or-later
"""The lines that `ssilk --json` prints, read back; lines of other programs are messages."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Event:
    """`kind` is one of ssilk's (started, progress, message, checkpoint, result, failed); the rest is its fields."""

    kind: str
    fields: dict[str, Any] = field(default_factory=dict)

    @property
    def text(self) -> str:
        """What the event says to people; empty where it says nothing."""
        return str(self.fields.get("text") or self.fields.get("error") or "")

    @property
    def fraction(self) -> float | None:
        """The part of the work that is done, in [0, 1], where the event says so."""
        done, total = self.fields.get("done"), self.fields.get("total")
        known = self.kind == "progress" and isinstance(done, int) and isinstance(total, int) and total > 0
        return min(max(done / total, 0.0), 1.0) if known else None  # type: ignore[operator]


def parse(line: str) -> Event:
    """Return the event that a line holds, or the line as a message."""
    try:
        document = json.loads(line)
        kind = document.pop("event")
    except (ValueError, KeyError, TypeError, AttributeError):
        return Event("message", {"text": line.strip()})
    return Event(str(kind), document)
