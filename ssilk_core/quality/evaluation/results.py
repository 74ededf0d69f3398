# SPDX-License-Identifier: Apache-2.0
"""The rows of an evaluation, with the models that they are of; `kept_rows` keeps them in a file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from ...events import Reporter
from ..kept_rows import KeptRows
from .figures import ResultRow
from .kept_parts import KeptParts, PartsFile

PARTS = ".parts"  # what is added to the name of the file for that of the parts of unfinished rows


@dataclass
class EvaluationResults:
    """Rows of an evaluation, each written when it is measured.

    Attributes:
        path: the file, or None.
        told: what the file says besides its rows.
        inputs: as `KeptRows` has them.
        rows: measured so far, each with the file of its model.
    """

    path: Path | None
    told: Mapping[str, Any]
    inputs: Mapping[str, Any]
    rows: list[tuple[str | None, ResultRow]] = field(default_factory=list)
    _parts: PartsFile = field(default_factory=lambda: PartsFile(None, {}), init=False)

    @property
    def kept(self) -> KeptRows[ResultRow]:
        """Where the rows are kept."""
        names = ("garment", "method", "split")
        return KeptRows(path=self.path, verb="evaluate", kind=ResultRow, names=names, inputs=self.inputs)

    def known(self, report: Reporter) -> list[ResultRow]:
        """Return the first rows that an earlier run wrote, as `KeptRows.known` does; `parts` are what it kept beside.

        Raises:
            SsilkError: one of both files is none of this verb.
        """
        rows = self.kept.known(report)
        path = self.path and self.path.with_name(self.path.name + PARTS)
        self._parts = PartsFile(path, self.inputs, report)
        if self.path and self.path.exists() and not rows:  # begun anew, as another version measured it
            self._parts.remove()
        return rows

    def parts(self, garment: int) -> KeptParts:
        """Return the parts of the rows of a garment, by its number in the evaluation."""
        return KeptParts(self._parts, (garment,))

    def add(self, model: str | None, row: ResultRow) -> None:
        """Add a row and write the file, which says that it is unfinished."""
        self._parts.write()  # first: a clip of this row may be in others
        self.rows.append((model, row))
        self.kept.write(self.told, self.figures, finished=False)

    def interrupted(self, report: Reporter) -> None:
        """Write what is known, and tell how much that is."""
        self._parts.write()
        self.kept.tell_kept(len(self.rows), report, parts=len(self._parts.parts))

    def finish(self) -> None:
        """Write the file as a finished one, without parts beside it."""
        self.kept.write(self.told, self.figures, finished=True)
        self._parts.remove()

    @property
    def figures(self) -> list[dict[str, Any]]:
        """The rows as the file holds them."""
        return [{"model": model, **asdict(row)} for model, row in self.rows]
