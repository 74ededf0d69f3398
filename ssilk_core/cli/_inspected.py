# SPDX-License-Identifier: Apache-2.0
"""What 'ssilk inspect' found of one garment."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import EXIT_BAD_INPUT, EXIT_OK

if TYPE_CHECKING:
    from ..authoring.preflight.finding import Finding


@dataclass(frozen=True)
class Inspected:
    """What was found of a garment; and what was repaired, where that was asked for."""

    findings: list[Finding]
    repaired: list[str] | None

    @property
    def code(self) -> int:
        return EXIT_BAD_INPUT if any(finding.severity == "error" for finding in self.findings) else EXIT_OK

    def detail(self, fix: Path | None) -> dict[str, object]:
        """Return it as a result tells it; `fix` is the repaired copy, where there is one."""
        return {"findings": self.findings} | (
            {"fixed": {"output": str(fix), "repaired": self.repaired}} if fix else {}
        )

    def text(self, fix: Path | None) -> str:
        """Return it in words."""
        from ..authoring.preflight.table import format_findings

        done = "\n  ".join([f"{fix}:", *(self.repaired or ["nothing to repair"])]) + "\n\n" if fix else ""
        return done + format_findings(self.findings)
