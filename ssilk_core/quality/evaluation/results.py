# SPDX-License-Identifier: Apache-2.0
"""The file of an evaluation: it grows row by row, and another run on the same inputs goes on from there."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from pathlib import Path
from types import NoneType
from typing import Any, get_args, get_origin, get_type_hints

from ...errors import SsilkError
from ...events import Message, Reporter, finite
from ...files import replacing
from .figures import ResultRow

UNFINISHED = "unfinished"  # only an unfinished file has this, with what to do as its value
GO_ON = "rows are missing; the same command, given again, measures them"


@dataclass
class EvaluationResults:
    """Rows of an evaluation, each written when it is measured.

    Attributes:
        path: the file, or None.
        told: what the file says besides its rows.
        inputs: hashes of the files and all settings that figures depend on, by name. Where they differ, a file is
            begun anew: figures of different inputs must not stand in one table, and outputs are replaced everywhere.
        rows: measured so far, each with the file of its model.
    """

    path: Path | None
    told: Mapping[str, Any]
    inputs: Mapping[str, Any]
    rows: list[tuple[str | None, ResultRow]] = field(default_factory=list)

    def known(self, report: Reporter) -> list[ResultRow]:
        """Return the first rows of these inputs that an earlier run wrote, and tell how many there are.

        Raises:
            SsilkError: the file is not one of 'ssilk evaluate'.
        """
        if self.path is None or not self.path.exists():
            return []
        try:
            document = json.loads(self.path.read_text())
            rows = [restored(ResultRow, row) for row in document["figures"]]
            before = document.get("inputs", {})
            changed = [name for name, value in _plain(self.inputs).items() if before.get(name) != value]
        except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            raise SsilkError(
                f"{self.path}: not figures of 'ssilk evaluate' ({type(error).__name__}: {error}); name another file."
            ) from error
        if changed:
            report(Message(f"{self.path}: begun anew, its figures are of other {', '.join(changed)}", "warning"))
            return []
        if rows:
            rest = "the others are measured" if UNFINISHED in document else "it is complete"
            report(Message(f"{self.path}: {len(rows)} rows were measured before and are taken over; {rest}"))
        return rows

    def add(self, model: str | None, row: ResultRow) -> None:
        """Add a row and write the file, which says that it is unfinished."""
        self.rows.append((model, row))
        self._write({UNFINISHED: GO_ON})

    def finish(self) -> None:
        """Write the file as a finished one."""
        self._write({})

    @property
    def figures(self) -> list[dict[str, Any]]:
        """The rows as the file holds them."""
        return [{"model": model, **asdict(row)} for model, row in self.rows]

    def _write(self, state: Mapping[str, str]) -> None:
        if self.path is None:
            return
        document = finite({**state, **self.told, "inputs": self.inputs, "figures": self.figures})
        with replacing(self.path, keep_same=True) as temporary:
            temporary.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n")


def restored(kind: Any, value: Any) -> Any:
    """Return a value of a type from what JSON holds of it; a number that is null there was not finite.

    Raises:
        KeyError, TypeError: it is no such value.
    """
    kinds = [one for one in get_args(kind) if one is not NoneType] if NoneType in get_args(kind) else [kind]
    if value is None and kinds != [kind]:
        return None
    (kind,) = kinds
    if is_dataclass(kind):
        hints = get_type_hints(kind)
        return kind(**{one.name: restored(hints[one.name], value[one.name]) for one in fields(kind)})  # type: ignore[operator]
    if get_origin(kind) is tuple:
        return tuple(restored(float, item) for item in value)
    if get_origin(kind) is dict:
        return {name: restored(float, item) for name, item in value.items()}
    if value is None and kind is float:
        return math.nan
    if not isinstance(value, (int, float) if kind is float else kind):
        raise TypeError(f"{value!r} is no {kind.__name__}")
    return value


def _plain(inputs: Mapping[str, Any]) -> dict[str, Any]:
    """Return inputs as JSON holds them."""
    found: dict[str, Any] = json.loads(json.dumps(finite(dict(inputs))))
    return found
