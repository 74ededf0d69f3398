# SPDX-License-Identifier: Apache-2.0
"""What the preflight has to say: one finding for each thing that an artist should know before training."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from ..assets import Skeleton

Severity = Literal["error", "warning", "info"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "info")  # the worst first


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One finding of the preflight.

    Attributes:
        severity: "error" (training fails or learns something else), "warning" (the result suffers) or "info".
        code: its kind, for machines and for grouping, such as "duplicate-vertices".
        prim: file and prim path that it is about.
        count: how many elements it is about.
        found, why, fix: what was found, why it matters and what to do, each one sentence or less.
        fixable: whether `ssilk inspect --fix` repairs all of it.
        elements: what `indices` count: "vertices", "faces" (triangles), "joints" or "frames"; empty for none.
        indices: the elements in question, for selecting them.
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
_ONE = {"vertices": "vertex", "isolated vertices": "isolated vertex"}


def amount(count: int, elements: str) -> str:
    """Return a number of elements in words: "1 vertex", "1,200 faces"."""
    return f"{count:,} {elements}" if count != 1 else f"1 {_ONE.get(elements, elements.removesuffix('s'))}"


def listing(indices: ArrayLike) -> tuple[int, ...]:
    """Return indices (N,) as plain integers, as `Finding.indices` holds them."""
    return tuple(np.asarray(indices, dtype=np.int64).tolist())


def joint_leaves(skeleton: Skeleton, joints: ArrayLike, most: int = 6) -> str:
    """Return the leaf names of joints (N,), the last ones as a number when they are too many to read."""
    words = [skeleton.joint_names[joint].rpartition("/")[2] for joint in np.asarray(joints)]
    return ", ".join(words[:most]) + (f" and {len(words) - most} more" if len(words) > most else "")
