# SPDX-License-Identifier: GPL-3.0-or-later
"""What `ssilk inspect` found, said of objects and motions.

A finding's `prim` is then the name of an object or of a motion, empty for the character as a whole. Faces become the
"polygons" of the object's mesh.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from ssilk_core.authoring.preflight.finding import SEVERITIES, Finding
from ssilk_core.authoring.preflight.fit import open_border
from ssilk_core.events import format_count
from ssilk_core.scene.assets import Mesh

HOLES = "body-not-watertight"
PUSHED, CROSSING = "penetration", "garments-cross"  # what Push Out mends; all others are mended by Fix
SETTLED = (PUSHED, "pierced", CROSSING)  # those that speak of what settling does
OPTION = "--fix"  # which does so in a console


@dataclass(frozen=True)
class Clip:
    """What people call a motion, and its first frame; None where its frames are not those of the timeline."""

    name: str
    start: int | None = None


def read_findings(
    documents: Sequence[Mapping[str, Any]],
    garment: str,
    meshes: Mapping[str, Mesh],
    clips: Mapping[str, Clip] = MappingProxyType({}),
) -> list[Finding]:
    """Return findings by object, the worst first, and last of a kind holes, which may be harmless.

    Those on several bodies as one come apart.

    Args:
        documents: the findings as `ssilk inspect --json` wrote them.
        garment: name of its object.
        meshes: by the names of objects the meshes that were inspected; their paths are those of their prims.
        clips: the motions that were inspected, by the paths of their files.
    """
    found: list[Finding] = []
    names = {mesh.path: name for name, mesh in meshes.items()}
    bodies = {name: mesh for name, mesh in meshes.items() if name != garment}
    for document in documents:
        finding = _with_buttons(Finding(**{**document, "indices": tuple(document["indices"])}))
        file, _, prim = finding.prim.rpartition(":")
        file = finding.prim if finding.prim in clips else file  # a motion that cannot be read has no prim
        finding = replace(finding, prim=names.get(prim, ""))
        if file in clips:
            found.append(_on_timeline(finding, clips[file]))
        elif finding.prim:
            found.append(on_polygons(finding, meshes[finding.prim]))
        elif finding.elements in {"vertices", "faces"}:
            found += _by_body(finding, bodies)
        else:
            found.append(finding)
    return sorted(found, key=lambda finding: (SEVERITIES.index(finding.severity), finding.code == HOLES))


def polygons_of(counts: np.ndarray, triangles: Sequence[int]) -> tuple[int, ...]:
    """Return the polygons, of which these are the counts of corners (P,), that have all of their triangles named."""
    owner = np.repeat(np.arange(len(counts)), counts - 2)
    named = np.bincount(owner[list(triangles)], minlength=len(counts))
    return tuple(np.flatnonzero(named == counts - 2).tolist())


def _with_buttons(finding: Finding) -> Finding:
    """Return a finding that speaks of the button which mends it, and not of an option."""
    button = "Push Out" if finding.code in SETTLED else "Fix"
    return replace(finding, found=finding.found.replace(OPTION, button), fix=finding.fix.replace(OPTION, button))


def _on_timeline(finding: Finding, clip: Clip) -> Finding:
    """Return a finding on a motion, with its frames as the timeline counts them."""
    if finding.elements == "frames" and clip.start is not None:
        finding = replace(finding, indices=tuple(clip.start + index for index in finding.indices))
    elif finding.elements == "frames":
        finding = replace(finding, elements="", indices=())
    return replace(finding, prim=clip.name)


def on_polygons(finding: Finding, mesh: Mesh) -> Finding:
    """Return a finding on triangles as one on polygons; on all of them where it names none."""
    if finding.elements != "faces":
        return finding
    polygons = polygons_of(np.asarray(mesh.polygon_counts), finding.indices or range(len(mesh.faces)))
    return replace(finding, elements="polygons", indices=polygons)


def _by_body(finding: Finding, bodies: Mapping[str, Mesh]) -> Iterator[Finding]:
    """Yield a finding on all bodies as one for each body that it is about."""
    start = 0
    for name, mesh in bodies.items():
        size = mesh.vertex_count if finding.elements == "vertices" else len(mesh.faces)
        own = tuple(index - start for index in finding.indices if start <= index < start + size)
        start += size
        if own or not finding.indices:
            found = finding.found if finding.code != HOLES else open_edges(mesh)
            yield on_polygons(replace(finding, prim=name, indices=own, found=found), mesh)


def open_edges(mesh: Mesh) -> str:
    """Return along how many edges one of several bodies is open."""
    return f"it is open along {format_count(open_border(mesh)[1], 'edges')}"
