# SPDX-License-Identifier: Apache-2.0
"""Show several trainings at once, as one redrawn line each or as plain lines, and a final table."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Mapping, Sequence
from typing import TextIO

from ...events import Event, GarmentEvent, Progress, Result, TaskEvent, describe, describe_progress, format_seconds

REDRAW = 0.1  # [s] interval between two redraws
REPEAT = 60.0  # [s] interval between two plain progress lines of one garment


class ProgressTable:
    """A reporter with one line for each garment on a terminal with enough rows, and plain lines elsewhere."""

    def __init__(self, names: Sequence[str], stream: TextIO | None = None) -> None:
        self.stream = stream or sys.stderr
        self.lines = dict.fromkeys(names, "waiting")
        self.columns, rows = shutil.get_terminal_size()
        self.live = self.stream.isatty() and len(names) < rows
        self._drawn = False
        self._last: dict[str, float] = {}

    def __call__(self, event: Event) -> None:
        if not isinstance(event, GarmentEvent):
            self._print(describe(event))
        elif not isinstance(event.said, Result):  # the table at the end has it
            self._hear(event.name, event.said)

    def _hear(self, name: str, said: TaskEvent) -> None:
        text = describe_progress(said) if isinstance(said, Progress) else describe(said)
        if self.live:
            self.lines[name] = text or self.lines[name]
            if self._is_due("", REDRAW) or not isinstance(said, Progress):
                self.draw()
        elif text and (not isinstance(said, Progress) or self._is_due(name, REPEAT)):
            self._print(f"{name}: {text}")

    def _is_due(self, what: str, seconds: float) -> bool:
        now = time.monotonic()
        due = now - self._last.get(what, -seconds) >= seconds
        if due:
            self._last[what] = now
        return due

    def _print(self, text: str) -> None:
        print(text, file=self.stream, flush=True)
        self._drawn = False

    def draw(self) -> None:
        """Redraw the lines."""
        width = max(map(len, self.lines))
        rows = (f"{name:<{width}}  {text}"[: self.columns - 1] for name, text in self.lines.items())
        up = f"\x1b[{len(self.lines)}A" if self._drawn else ""
        print(up + "".join(f"\r\x1b[K{row}\n" for row in rows), end="", file=self.stream, flush=True)
        self._drawn = True


def table(rows: Sequence[Mapping[str, object]]) -> str:
    """Format rows with the same keys as columns; the first and last are left-aligned, the others right-aligned.

    The column "time" is in seconds. None is an empty cell.
    """
    cells = [[*rows[0]], *([_cell(name, value) for name, value in row.items()] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells)]
    lines = []
    for first, *middle, last in cells:
        aligned = [cell.rjust(width) for cell, width in zip(middle, widths[1:])]
        lines.append("  ".join([first.ljust(widths[0]), *aligned, last]))
    return "\n".join(lines)


def _cell(name: str, value: object) -> str:
    if name == "time" and isinstance(value, float):
        return format_seconds(value)
    return "" if value is None else str(value)
