# SPDX-License-Identifier: Apache-2.0
"""Findings of the preflight: what an artist should know before training."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ...scene.assets import Skeleton

Severity = Literal["error", "warning", "info"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "info")  # the worst first


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One finding of the preflight.

    Attributes:
        severity: "error" (training fails or learns the wrong thing), "warning" (the result suffers) or "info".
        code: identifier of its kind, such as "duplicate-vertices".
        prim: file and prim path that it concerns.
        count: number of elements that it concerns.
        found, why, fix: what was found, why it matters and what to do, each at most one sentence.
        fixable: whether `ssilk inspect --fix` repairs all of it.
        elements: kind of elements: "vertices", "faces" (triangles), "joints" or "frames"; empty for none.
        indices: indices of the elements, for selection.
    """

    severity: Severity
    code: str
    prim: str
    found: str
    why: str = ""
    fix: str = ""
    count: int = 1
    fixable: bool = False
    elements: str = ""
    indices: tuple[int, ...] = ()


Findings = Iterator[Finding]


def index_tuple(indices: ArrayLike) -> tuple[int, ...]:
    """Return indices (N,) as a tuple of plain integers for `Finding.indices`."""
    return tuple(np.asarray(indices, dtype=np.int64).tolist())


def format_joints(skeleton: Skeleton, joints: ArrayLike, most: int = 6) -> str:
    """Format joints (N,) by their leaf names, at most `most` of them, then the number of the others."""
    words = [skeleton.joint_names[joint].rpartition("/")[2] for joint in np.asarray(joints)]
    return ", ".join(words[:most]) + (f" and {len(words) - most} more" if len(words) > most else "")
