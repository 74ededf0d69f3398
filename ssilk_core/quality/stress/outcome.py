# SPDX-License-Identifier: Apache-2.0
"""The outcome of one extreme, and tables of outcomes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from .meter import Extent

Verdict = Literal["works", "falls back", "refuses", "does not apply", "breaks"]
HEADER = ("extreme", "what happens", "frames", "bounded", "speed [m/s]", "off linear blend skinning [m]", "latent",
          "energy growth", "error", "s")  # fmt: skip


class DoesNotApply(Exception):
    """Raised by a case that a model has no input for; it says why, without a stop."""


@dataclass(frozen=True)
class CaseMeasurement:
    """Results of a case: the extent of a rollout, if any, an error with its unit, and a note."""

    extent: Extent | None = None
    error: float | None = None
    unit: str = ""
    note: str = ""

    @property
    def verdict(self) -> Verdict:
        if self.extent is None:
            return "works"
        if not self.extent.bounded:
            return "breaks"
        return "falls back" if self.extent.recovered else "works"


@dataclass(frozen=True)
class CaseOutcome:
    """One row of the table.

    Attributes:
        name, group: labels of the case.
        verdict: behaviour of the product; "breaks" is always a fault.
        said: error message of a refusal, or a note.
        measured: results; empty for a refusal.
        seconds: duration of the case [s].
    """

    name: str
    group: str
    verdict: Verdict
    said: str
    measured: CaseMeasurement
    seconds: float

    @property
    def label(self) -> str:
        """As `cases.Case.label`."""
        return f"{self.group}: {self.name}"

    def row(self) -> list[str]:
        """Return the cells of the row."""
        found, error = self.measured.extent, self.measured.error
        figures = ["", "", "", "", "", ""]
        if found:
            figures = [
                f"{found.frames:,}", "yes" if found.bounded else "no", f"{found.speed:.3g}", f"{found.distance:.3g}",
                f"{found.latent:.3g}", f"{found.growth:.3g}",
            ]  # fmt: skip
        off = "" if error is None else f"{error:.2g} {self.measured.unit}".strip()
        words = f"{self.verdict}: {self.said}" if self.said else self.verdict
        return [self.label, words, *figures, off, f"{self.seconds:.0f}"]


def markdown(outcomes: Sequence[CaseOutcome]) -> str:
    """Return outcomes as a Markdown table."""
    lines = [HEADER, ["---"] * 2 + ["---:"] * (len(HEADER) - 2), *(outcome.row() for outcome in outcomes)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"
