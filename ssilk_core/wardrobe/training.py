# SPDX-License-Identifier: Apache-2.0
"""One garment of a list among the files of its folder: what there is to do, and how it went."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

from ..errors import EXIT_INTERNAL, EXIT_INTERRUPTED, EXIT_OK
from .listing import WardrobeEntry
from .queue import CommandTask, End
from .record import TrainingRecord, load_record, save_record

COLUMNS = ("garment", "iterations", "total [J]", "lower by", "collisions", "time", "state")


class GarmentTraining:
    """One garment of a list.

    Attributes:
        state: "waiting", "training", "finished", "stopped" or "failed".
        code: exit code of its training; that of an interrupt where it was not begun.
        error: why it failed.
        plan: what is done about it, in words; nothing where it just waits.
    """

    def __init__(self, entry: WardrobeEntry, folder: Path, request: str) -> None:
        self.entry, self.folder = entry, folder
        before = load_record(self._file(".json"))
        same = before is not None and before.asked == request
        self.record = before if before is not None and same else TrainingRecord(request)
        finished = self.record.result is not None and self._file(".safetensors").exists()
        self.resumed = same and not finished and self._file(".resume.safetensors").exists()
        self.state, self.code = ("finished", EXIT_OK) if finished else ("waiting", EXIT_INTERRUPTED)
        self.figures, self.error = self.record.result or {}, ""
        self.plan = (
            "finished before; skipped" if finished
            else "goes on from where it stopped" if self.resumed
            else "something else was asked before; trains anew" if before is not None and not same
            else ""
        )  # fmt: skip

    def _file(self, suffix: str) -> Path:
        return self.folder / f"{self.entry.name}{suffix}"

    def begin(self, source: Path, device: str) -> CommandTask:
        """Return the training as a task, run in the folder `source` that the list's paths are relative to."""
        model, log = self._file(".safetensors").absolute(), self._file(".log")
        save_record(self._file(".json"), replace(self.record, result=None))
        if not self.resumed:
            for old in (log, self._file(".resume.safetensors")):
                old.unlink(missing_ok=True)
        words = [*self.entry.words, "-o", str(model), "--device", device, "--json", *["--resume"] * self.resumed]
        return CommandTask(self.entry.name, [sys.executable, "-m", "ssilk_core", "train", *words], source, log)

    def end(self, end: End) -> None:
        """Take note of how it ended."""
        self.code = end.code if end.code >= 0 else EXIT_INTERNAL
        self.state = {EXIT_OK: "finished", EXIT_INTERRUPTED: "stopped"}.get(end.code, "failed")
        self.figures = {} if end.result is None else end.result.detail
        result = self.figures if self.state == "finished" else None
        self.record = replace(self.record, seconds=self.record.seconds + end.seconds, result=result)
        save_record(self._file(".json"), self.record)

    def row(self) -> dict[str, object]:
        """Return what is said of it at the end, by the names in `COLUMNS`; the time is in seconds."""
        found = self.figures
        lower = found.get("lower by") or (f"-{found['higher by']}" if "higher by" in found else None)
        figures = [found.get("iterations"), found.get("total [J]"), lower, found.get("collisions")]
        return dict(zip(COLUMNS, [self.entry.name, *figures, round(self.record.seconds, 1), self.state]))
