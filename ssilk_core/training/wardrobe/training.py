# SPDX-License-Identifier: Apache-2.0
"""The training of one garment of a list: remaining work, and result."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from ...errors import EXIT_INTERNAL, EXIT_INTERRUPTED, EXIT_OK, EXIT_TASKS, EXIT_WORSE, fail
from ...files import sha256
from ...work_record import WorkRecord, read_record, write_record
from .listing import MODEL, WardrobeEntry
from .queue import CommandTask, End

WORSE_FIGURE = "worse than linear blend skinning"  # among the figures of a training, where that is so
COLUMNS = ("garment", "iterations", "total [J]", "lower by", "collisions", "skin shows", "bare", "time", "state")


class GarmentTraining:
    """The training of one garment, with its model, state, log and record in a folder.

    Args:
        before: the trainings of the list so far, by name: those of its inner garments come first.

    Attributes:
        state: "waiting", "finished", "stopped" or "failed".
        code: exit code of the training; that of an interrupt if it did not start.
        error: reason of a failure.
        plan: message about how it will run; empty for a new training.
    """

    def __init__(
        self, entry: WardrobeEntry, folder: Path, request: str, before: Mapping[str, GarmentTraining] | None = None
    ) -> None:
        self.entry, self.folder = entry, folder
        self.inner = [(before or {})[name] for name in entry.over]
        there = read_record(self._file(".json"))
        same = there is not None and there.key == request
        self.record = there if there is not None and same else WorkRecord(key=request)
        done = self.record.is_done(folder)
        finished = done and self._over_same()
        self.resumed = same and not done and self._file(".resume.safetensors").exists()
        self.state, self.code = ("finished", EXIT_OK) if finished else ("waiting", EXIT_INTERRUPTED)
        detail = self.record.detail
        if not isinstance(detail.get("seconds", 0.0), int | float) or (finished and "result" not in detail):
            fail(
                str(self._file(".json")),
                "this record of finished work is damaged",
                "it says what need not be done again",
                "delete it to train again",
            )
        self.seconds = float(detail.get("seconds", 0.0))
        self.figures, self.error = self.record.detail["result"] if finished else {}, ""
        if finished and WORSE_FIGURE in self.figures:
            self.code = EXIT_WORSE
        self.plan = (
            "finished before; skipped" if finished
            else "resumes where it stopped" if self.resumed
            else "its entry or inputs have changed; trains again" if there is not None and not same
            else "what it is worn over is trained again, and so is it" if done
            else "its model was changed or removed; trains again" if there is not None and there.files
            else ""
        )  # fmt: skip

    def _file(self, suffix: str) -> Path:
        return self.folder / f"{self.entry.name}{suffix}"

    def _over_same(self) -> bool:
        """Return whether all inner garments are finished, with the models that this one was trained over."""
        done = all(inner.state == "finished" for inner in self.inner)
        return done and self.record.detail.get("over", {}) == self._over()

    def _over(self) -> dict[str, str]:
        """Return SHA-256 of the models of its inner garments, by their names in the list."""
        return {inner.entry.name: sha256(inner._file(MODEL)) for inner in self.inner}

    def skip(self, inner: str) -> None:
        """End it without a training, because that of an inner garment gave no model."""
        self.state, self.code = "failed", EXIT_TASKS
        self.error = f"it is worn over '{inner}', of which there is no model; once there is, the same command goes on"

    def begin(self, source: Path, device: str) -> CommandTask:
        """Return the training as a task that runs in `source`, the folder that the list's paths are relative to."""
        model, log = self._file(".safetensors").absolute(), self._file(".log")
        over = self._over()
        self.resumed &= over == self.record.detail.get("over", {})
        self.record = replace(
            self.record, files={}, detail={**self.record.detail, **({"over": over} if over else {})}
        )
        write_record(self._file(".json"), self.record)
        if not self.resumed:
            for old in (log, self._file(".resume.safetensors")):
                old.unlink(missing_ok=True)
        given = [word for inner in self.inner for word in ("--over", str(inner._file(MODEL).absolute()))]
        words = [
            *self.entry.words,
            *given,
            "-o",
            str(model),
            "--device",
            device,
            "--json",
            *["--resume"] * self.resumed,
        ]
        return CommandTask(self.entry.name, [sys.executable, "-m", "ssilk_core", "train", *words], source, log)

    def end(self, end: End) -> None:
        """Record the end of the training."""
        self.code = end.code if end.code >= 0 else EXIT_INTERNAL
        self.state = {EXIT_OK: "finished", EXIT_WORSE: "finished", EXIT_INTERRUPTED: "stopped"}.get(
            end.code, "failed"
        )
        self.figures = {} if end.result is None else end.result.detail
        self.seconds += end.seconds
        model = self._file(".safetensors")
        files = {model.name: sha256(model)} if self.state == "finished" else {}
        over = {"over": self.record.detail["over"]} if "over" in self.record.detail else {}
        detail = {"seconds": self.seconds, "result": self.figures, **over}
        self.record = WorkRecord(key=self.record.key, files=files, detail=detail)
        write_record(self._file(".json"), self.record)

    def row(self) -> dict[str, object]:
        """Return its line of the final table, by the names in `COLUMNS`; the time is in seconds."""
        found = self.figures
        lower = found.get("lower by") or (f"-{found['higher by']}" if "higher by" in found else None)
        figures = [
            found.get("iterations"),
            found.get("total [J]"),
            lower,
            found.get("collisions"),
            found.get("covered skin that shows"),
            found.get("bare"),
        ]
        return dict(zip(COLUMNS, [self.entry.name, *figures, round(self.seconds, 1), self.state]))
