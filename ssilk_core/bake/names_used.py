# SPDX-License-Identifier: Apache-2.0
"""What the names in a folder of layers were used for: a name stays with its input."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NoReturn

from ..errors import fail
from .inputs import InputContents, model_contents, stage_contents
from .record import RECORD, RecordedInput, TaskRecord, portable, read_record
from .task import BakeTask


class UsedNames:
    """The names of a folder of layers; what it reads of the folder is remembered.

    An input is the same as before if it has the same path or the same contents.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.shots: dict[str, dict[str, TaskRecord]] = {}
        self.garments: dict[str, TaskRecord | None] = {}

    def check(self, task: BakeTask) -> None:
        """Raise `SsilkError` where the names of a task were used for another motion, model or SkelRoot."""
        request, shot = task.request, self._shot(task.shot)
        for record in shot.values():
            before = record.inputs.get("motion")
            if before and not self._same(before, request.motion, stage_contents):
                self._fail("shot", task.shot, before.path, request.motion)
        used = shot.get(task.garment) or self._garment(task.garment)
        if used is None:
            return
        before = used.inputs.get("model")
        if before and not self._same(before, request.model, model_contents):
            self._fail("garment", task.garment, before.path, request.model)
        if used.root != request.root:
            roots = (f"{request.model}:{root}" if root else request.model for root in (used.root, request.root))
            self._fail("garment", task.garment, *roots)

    def _shot(self, name: str) -> dict[str, TaskRecord]:
        """Return the records of the garments in a shot."""
        if name not in self.shots:
            found = {path.parent.name: read_record(path.parent) for path in self._records(name, "*")}
            self.shots[name] = {garment: record for garment, record in sorted(found.items()) if record}
        return self.shots[name]

    def _garment(self, name: str) -> TaskRecord | None:
        """Return the record of a garment in any of its shots, which share its asset."""
        if name not in self.garments:
            found = (read_record(path.parent) for path in self._records("*", name))
            self.garments[name] = next(filter(None, found), None)
        return self.garments[name]

    def _records(self, shot: str, garment: str) -> Iterator[Path]:
        return self.folder.glob(f"shots/{shot}/{garment}/{RECORD}")

    def _same(self, before: RecordedInput, location: str, contents: Callable[[str], InputContents]) -> bool:
        """Return whether an input is the one that a record names."""
        from ssilk_usd.read_stage import split_location

        if before.path == portable(location, self.folder):
            return True
        then, now = split_location(before.path), split_location(location)
        if not Path(now[0]).is_file():
            return True  # which is told when it is read
        if then[1] != now[1]:
            return False
        place = self.folder / then[0]
        return (place.is_file() and os.path.samefile(place, now[0])) or before.sha256 == contents(now[0]).digest

    def _fail(self, kind: str, name: str, before: str, now: str) -> NoReturn:
        fail(
            str(self.folder),
            f"the {kind} '{name}' was baked from '{before}', not from '{now}'",
            "a name stays with its input",
            f"name this {kind} with --{kind}-name, or use the name all the same with --replace",
        )
