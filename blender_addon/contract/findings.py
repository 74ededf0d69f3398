# SPDX-License-Identifier: GPL-3.0-or-later
"""What `ssilk inspect` found, in terms of the meshes that were handed over."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from .arrays import Dressed


@dataclass(frozen=True)
class Finding:
    """One finding of the preflight.

    Attributes:
        severity: "error", "warning" or "info".
        code: its kind, such as "duplicate-vertices".
        target: name of the object or the motion that it is about; empty for the character as a whole.
        found, why, fix: what was found, why it matters and what to do.
        fixable: whether all of it can be repaired without asking.
        elements: what `indices` count: "vertices", "polygons", "joints", "frames" of the timeline, or nothing.
    """

    severity: str
    code: str
    target: str
    found: str
    why: str = ""
    fix: str = ""
    fixable: bool = False
    elements: str = ""
    indices: tuple[int, ...] = ()


@dataclass(frozen=True)
class Clip:
    """What people call a motion, and its first frame; None where its frames are not those of the timeline."""

    name: str
    start: int | None = None


def read_findings(
    documents: Sequence[Mapping[str, Any]],
    dressed: Dressed,
    prims: Mapping[str, str],
    clips: Mapping[str, Clip] = MappingProxyType({}),
) -> list[Finding]:
    """Return findings by object; those on several bodies as one come apart.

    Args:
        documents: the findings as `ssilk inspect --json` wrote them.
        prims: path of each mesh in the stage by the name of its object.
        clips: the motions that were inspected, by the paths of their files.
    """
    found: list[Finding] = []
    names = {prim: name for name, prim in prims.items()}
    for document in documents:
        file, _, prim = str(document["prim"]).rpartition(":")
        kept = {key: document[key] for key in ("severity", "code", "found", "why", "fix", "fixable", "elements")}
        finding = Finding(target=names.get(prim, ""), indices=tuple(document["indices"]), **kept)
        if file in clips:
            found.append(_on_timeline(finding, clips[file]))
        elif not finding.target and finding.elements in {"vertices", "faces"}:
            found += _by_body(finding, dressed)
        else:
            found.append(_on_polygons(finding, dressed))
    return found


def _on_timeline(finding: Finding, clip: Clip) -> Finding:
    """Return a finding on a motion, with its frames as the timeline counts them."""
    if finding.elements == "frames" and clip.start is not None:
        finding = replace(finding, indices=tuple(clip.start + index for index in finding.indices))
    elif finding.elements == "frames":
        finding = replace(finding, elements="", indices=())
    return replace(finding, target=clip.name)


def polygons_of(counts: np.ndarray, triangles: Sequence[int]) -> tuple[int, ...]:
    """Return the polygons, of which these are the counts of corners (P,), that have all of their triangles named."""
    owner = np.repeat(np.arange(len(counts)), counts - 2)
    named = np.bincount(owner[list(triangles)], minlength=len(counts))
    return tuple(np.flatnonzero(named == counts - 2).tolist())


def _on_polygons(finding: Finding, dressed: Dressed) -> Finding:
    """Return a finding on triangles as one on polygons; on all of them where it names none."""
    if finding.elements != "faces":
        return finding
    shape = next(shape for shape in (dressed.garment, *dressed.bodies) if shape.name == finding.target)
    every = range(int((shape.counts - 2).sum()))
    return replace(finding, elements="polygons", indices=polygons_of(shape.counts, finding.indices or every))


def _by_body(finding: Finding, dressed: Dressed) -> list[Finding]:
    """Return a finding on all bodies as one for each body that it is about."""
    found, start = [], 0
    for body in dressed.bodies:
        size = len(body.points) if finding.elements == "vertices" else int((body.counts - 2).sum())
        own = tuple(index - start for index in finding.indices if start <= index < start + size)
        start += size
        if own or not finding.indices:
            found.append(_on_polygons(replace(finding, target=body.name, indices=own), dressed))
    return found
