# SPDX-License-Identifier: Apache-2.0
"""The file of a long measurement: it grows row by row, and another run on the same inputs goes on from there."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Generic, TypeVar

from ..errors import SsilkError
from ..events import Message, Reporter, finite
from ..files import replacing
from ..scene.plain import OtherFieldsError, from_plain

UNFINISHED = "unfinished"  # only an unfinished file has this, with what to do as its value
GO_ON = "rows are missing; the same command, given again, measures them"

Row = TypeVar("Row")


@dataclass(frozen=True, kw_only=True)
class KeptRows(Generic[Row]):
    """Where the rows of a measurement are kept.

    Attributes:
        path: the file, or None for none.
        verb: that measures.
        kind: of the rows, a dataclass.
        names: fields that tell a row from others, which rows of every version have.
        inputs: hashes of the files and all settings that figures depend on, by name. Where they differ, a file is
            begun anew: figures of different inputs must not stand in one table, and outputs are replaced everywhere.
        inputs_at, rows_at: under what the file holds inputs and rows.
        beside: lists of other figures of the same run that the file tells, a dataclass for each by its name there.
    """

    path: Path | None
    verb: str
    kind: type[Row]
    names: Sequence[str]
    inputs: Mapping[str, Any]
    inputs_at: str = "inputs"
    rows_at: str = "figures"
    beside: Mapping[str, type] = field(default_factory=dict)

    def known(self, report: Reporter) -> list[Row]:
        """Return the rows of these inputs that an earlier run wrote, and tell how many there are.

        None are taken over from a file of other inputs, or of a version that measured other figures.

        Raises:
            SsilkError: the file is none of this verb.
        """
        if self.path is None or not self.path.exists():
            return []
        try:
            document = json.loads(self.path.read_text())
            written, before = list(document[self.rows_at]), document.get(self.inputs_at, {})
            changed = [name for name, value in _plain(self.inputs).items() if before.get(name) != value]
            for row in written:
                _ = [row[name] for name in self.names]
            other = f"its figures are of other {', '.join(changed)}" if changed else ""
            rows = [] if changed else [self._row(row) for row in written]
            for name, kind in () if changed else self.beside.items():
                _ = [from_plain(kind, each, figures=True) for each in document.get(name, ())]
        except OtherFieldsError as error:
            other, rows = f"another version measured its figures ({error})", []
        except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            found = f"not figures of 'ssilk {self.verb}' ({type(error).__name__}: {error})"
            raise SsilkError(f"{self.path}: {found}; name another file.") from error
        if other:
            report(Message(f"{self.path}: begun anew, {other}", "warning"))
        elif rows:
            rest = "the others are measured" if UNFINISHED in document else "it is complete"
            report(Message(f"{self.path}: {len(rows)} rows were measured before and are taken over; {rest}"))
        return rows

    def told(self) -> dict[str, Any]:
        """Return what the file tells, of which `known` has taken rows over; nothing without a file."""
        if self.path is None or not self.path.exists():
            return {}
        document: dict[str, Any] = json.loads(self.path.read_text())
        return document

    def write(self, told: Mapping[str, Any], rows: Sequence[Mapping[str, Any]], *, finished: bool) -> None:
        """Write what the file tells and its rows; one that is not finished says so.

        Args:
            rows: as `dataclasses.asdict` makes them; they may hold more than their dataclass.
        """
        if self.path is None:
            return
        state = {} if finished else {UNFINISHED: GO_ON}
        document = finite({**state, **told, self.inputs_at: self.inputs, self.rows_at: rows})
        with replacing(self.path, keep_same=True) as temporary:
            temporary.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")

    def tell_kept(self, count: int, report: Reporter, parts: int = 0) -> None:
        """Tell that a measurement was interrupted, of which so many rows are kept, and parts of the next ones."""
        if self.path is not None and (count or parts):
            beside = ", and parts of the next" if parts else ""
            report(Message(f"{self.path}: {count} rows are kept{beside}; other {GO_ON}"))

    def _row(self, document: Mapping[str, Any]) -> Row:
        """Return a row, without what the file tells beside its figures."""
        own = {item.name for item in fields(self.kind)}  # type: ignore[arg-type]
        return from_plain(self.kind, {name: value for name, value in document.items() if name in own}, figures=True)


def _plain(inputs: Mapping[str, Any]) -> dict[str, Any]:
    """Return inputs as JSON holds them."""
    found: dict[str, Any] = json.loads(json.dumps(finite(dict(inputs))))
    return found
