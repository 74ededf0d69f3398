# SPDX-License-Identifier: Apache-2.0
"""Check the vertex classes and islands that keep the garment on the body."""

from __future__ import annotations

import numpy as np

from ...scene.assets import CLASS_NAMES, LOOSE, Ints, Mesh
from ...scene.mesh.stitches import TOUCH, find_carried, find_feet, find_stitches, joined_islands, touching
from ...scene.mesh.topology import adrift, islands
from ..setup.surface import closest_on_surface
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
    """Yield the islands of a garment without a pinned or tight vertex; isolated vertices do not count.

    What stitches join counts as one island.
    """
    island = joined_islands(mesh, find_stitches(mesh))
    falling = adrift(mesh.faces, island, classes != LOOSE)
    if len(falling):
        lost = np.flatnonzero(np.isin(island, falling))
        yield Finding(
            severity="error",
            code="unheld-islands",
            prim=mesh.path,
            count=len(lost),
            found=f"{len(falling)} of {len(np.unique(island[mesh.faces]))} islands have no pinned or tight vertex",
            why="nothing attaches them, so they fall off the body",
            fix="paint a part of each as pinned or tight (primvars:ssilk:class), or sew it to the rest",
            elements="vertices",
            indices=index_tuple(lost),
        )


def stitched_islands(mesh: Mesh, classes: Ints) -> Findings:
    """Yield what lies on other islands and is stitched to them, and how much of it these carry."""
    feet = find_feet(mesh)
    on_hosts = find_carried(mesh, feet)
    stitches, island = touching(mesh, feet, on_hosts), islands(mesh.faces, mesh.vertex_count)
    held = stitches.select(stitches.on_larger & _moves(classes, stitches.vertices, stitches.corners))
    parts = np.unique(island[held.vertices])
    carried = np.intersect1d(parts, island[on_hosts.vertices])
    if len(parts):
        whole = len(np.unique(island[mesh.faces]))
        yield Finding(
            severity="info",
            code="stitched-islands",
            prim=mesh.path,
            count=len(held),
            found=f"{len(parts)} of {whole} islands lie on others: stitches (of the material) hold them there, and "
            f"{len(carried)} that lie wholly on others take their weights and classes from these",
            elements="vertices",
            indices=index_tuple(held.vertices),
        )


def touching_islands(mesh: Mesh, classes: Ints) -> Findings:
    """Yield where islands are near others without being joined to them or lying on them, and one of both is loose.

    Of two islands the smaller one is told. One that a stitch or a class holds anywhere is not.
    """
    stitches, island = find_stitches(mesh), islands(mesh.faces, mesh.vertex_count)
    sewn = np.unique(island[stitches.vertices])
    of_face = island[mesh.faces[:, 0]]
    numbers, sizes = np.unique(of_face, return_counts=True)
    order = numbers[np.argsort(-sizes, kind="stable")]
    found, parts = [], 0
    for place, number in enumerate(order[1:], start=1):
        if number in sewn:
            continue
        own = np.unique(mesh.faces[of_face == number])
        others = mesh.faces[np.isin(of_face, order[:place])]
        near = closest_on_surface(mesh.points[own], Mesh(mesh.path, mesh.points, others))
        touch = own[(near.distance < TOUCH) & _moves(classes, own, near.corners)]
        parts += len(touch) > 0
        found.append(touch)
    loose = np.concatenate(found) if found else np.zeros(0, dtype=np.int64)
    if len(loose):
        yield Finding(
            severity="warning",
            code="touching-islands",
            prim=mesh.path,
            count=len(loose),
            found=f"{parts} of {len(order)} islands touch others side by side without being joined to them",
            why="stitches hold only what lies on other cloth, and cloth does not collide with cloth",
            fix="join them by edges (merge or bridge vertices), or lay one over the other, outsides the same way, "
            "unless they are to part",
            elements="vertices",
            indices=index_tuple(loose),
        )


def _moves(classes: Ints, vertices: Ints, corners: Ints) -> np.ndarray:
    """Return where vertices (N,) or one of three corners each (N, 3) are loose, shape (N,)."""
    return (classes[vertices] == LOOSE) | (classes[corners] == LOOSE).any(axis=1)
