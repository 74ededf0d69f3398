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

    @property
    def kept(self) -> KeptRows[ResultRow]:
        """Where the rows are kept."""
        names = ("garment", "method", "split")
        return KeptRows(path=self.path, verb="evaluate", kind=ResultRow, names=names, inputs=self.inputs)

    def known(self, report: Reporter) -> list[ResultRow]:
        """Return the first rows that an earlier run wrote, as `KeptRows.known` does."""
        return self.kept.known(report)

    def add(self, model: str | None, row: ResultRow) -> None:
        """Add a row and write the file, which says that it is unfinished."""
        self.rows.append((model, row))
        self.kept.write(self.told, self.figures, finished=False)

    def finish(self) -> None:
        """Write the file as a finished one."""
        self.kept.write(self.told, self.figures, finished=True)

    @property
    def figures(self) -> list[dict[str, Any]]:
        """The rows as the file holds them."""
        return [{"model": model, **asdict(row)} for model, row in self.rows]
