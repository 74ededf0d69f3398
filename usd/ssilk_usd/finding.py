# SPDX-License-Identifier: Apache-2.0
"""The findings of `check_shot`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from pxr import Usd


@dataclass(frozen=True)
class ShotFinding:
    """`severity` is "error" (some reader will show something else) or "warning"; `prim` is a path, or empty."""

    severity: str
    prim: str
    text: str

    def __str__(self) -> str:
        return f"{self.severity}: {self.prim or 'stage'}: {self.text}"


def error_unless(condition: object, prim: Usd.Prim, text: str) -> Iterator[ShotFinding]:
    """Yield an error about `prim` unless `condition` holds."""
    if not condition:
        yield ShotFinding("error", str(prim.GetPath()), text)
