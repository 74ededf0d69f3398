# SPDX-License-Identifier: Apache-2.0
"""Check the vertex classes and islands that keep the garment on the body."""

from __future__ import annotations

import numpy as np

from ..assets import CLASS_NAMES, LOOSE, Ints, Mesh
from ..mesh.topology import islands
from ..setup.surface import closest_on_surface
from .finding import Finding, Findings, index_tuple

TOUCH = 0.005  # [m] between islands that lie on each other


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


def touching_islands(mesh: Mesh, classes: Ints) -> Findings:
    """Yield the places where an island lies on another one that it is not joined to, and one of both is loose there.

    Of two islands the smaller one is told, as a pocket or a button is.
    """
    island = islands(mesh.faces, mesh.vertex_count)
    of_face = island[mesh.faces[:, 0]]
    numbers, sizes = np.unique(of_face, return_counts=True)
    order = numbers[np.argsort(-sizes, kind="stable")]
    found, parts = [], 0
    for place, number in enumerate(order[1:], start=1):
        own = np.unique(mesh.faces[of_face == number])
        others = mesh.faces[np.isin(of_face, order[:place])]
        near = closest_on_surface(mesh.points[own], Mesh(mesh.path, mesh.points, others))
        moves = (classes[own] == LOOSE) | (classes[near.corners] == LOOSE).any(axis=1)
        touching = own[(near.distance < TOUCH) & moves]
        parts += len(touching) > 0
        found.append(touching)
    touching = np.concatenate(found) if found else np.zeros(0, dtype=np.int64)
    if len(touching):
        yield Finding(
            severity="warning",
            code="touching-islands",
            prim=mesh.path,
            count=len(touching),
            found=f"{parts} of {len(order)} islands lie on others without being joined to them",
            why="nothing holds loose cloth of two islands together, and cloth does not collide with cloth",
            fix="join them by edges (merge or bridge vertices), or pin the smaller one where it is stiff",
            elements="vertices",
            indices=index_tuple(touching),
        )
