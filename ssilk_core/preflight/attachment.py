# SPDX-License-Identifier: Apache-2.0
"""Check the vertex classes and islands that keep the garment on the body."""

from __future__ import annotations

import numpy as np

from ..assets import CLASS_NAMES, LOOSE, Ints, Mesh
from ..mesh.topology import islands
from .finding import Finding, Findings, index_tuple


def class_coverage(mesh: Mesh, classes: Ints) -> Findings:
    """Yield the numbers of pinned, tight and loose vertices in `classes` (V,)."""
    counts = np.bincount(classes, minlength=len(CLASS_NAMES))
    told = ", ".join(f"{count:,} {name}" for name, count in zip(CLASS_NAMES, counts))
    notes = {
        "; nothing is loose, so no proxies are needed": counts[LOOSE] == 0,
        "; all are pinned, so the garment only follows the skeleton": counts[0] == mesh.vertex_count,
    }
    yield Finding(
        severity="info",
        code="classes",
        prim=mesh.path,
        found=f"{told} of {mesh.vertex_count:,} vertices"
        + next((n for n, holds in reversed(notes.items()) if holds), ""),
    )


def unattached_islands(mesh: Mesh, classes: Ints) -> Findings:
    """Yield the islands of a garment without a pinned or tight vertex; isolated vertices do not count."""
    island = islands(mesh.faces, mesh.vertex_count)
    adrift = np.setdiff1d(island[np.unique(mesh.faces)], island[np.flatnonzero(classes != LOOSE)])
    if len(adrift):
        lost = np.flatnonzero(np.isin(island, adrift))
        yield Finding(
            severity="error",
            code="unheld-islands",
            prim=mesh.path,
            count=len(lost),
            found=f"{len(adrift)} of {len(np.unique(island[mesh.faces]))} islands have no pinned or tight vertex",
            why="nothing attaches them, so they fall off the body",
            fix="paint a part of each as pinned or tight (primvars:ssilk:class), or sew it to the rest",
            elements="vertices",
            indices=index_tuple(lost),
        )
