# SPDX-License-Identifier: Apache-2.0
"""Check that a garment starts over the garments that it is worn over, and does not cross them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ...physics.intersections.figures import LIBIGL
from ...physics.intersections.pairs import can_find, intersections_between
from ...scene.assets import Character, Mesh
from ...scene.mesh.topology import vertex_mask
from .finding import Finding, Findings, format_joints, index_tuple
from .fit import joints_at
from .inner_surface import Sheet
from .settle import FARTHEST, settle

MOST_REGIONS = 3


def layers(mesh: Mesh, character: Character, inner: Mapping[str, Mesh]) -> Findings:
    """Yield what of a garment crosses each of the garments beneath it, or lies beneath them, in the bind pose.

    Args:
        inner: the garments that it is worn over, by name.
    """
    if not inner:
        return
    if not can_find():
        text = f"garments over one another were not checked, as libigl {LIBIGL} or newer is missing"
        yield Finding(severity="info", code="not-checked", prim=mesh.path, found=text)
        return
    body = character.merged_body().mesh
    found = {name: _Crossing(mesh, other, body) for name, other in inner.items()}
    if not any(each.count for each in found.values()):
        return
    settled = settle(mesh, body, inner=list(inner.values()))
    after = mesh.points + settled.offsets
    for name, each in found.items():
        if not each.count:
            continue
        left = len(np.unique(intersections_between(after, mesh.faces, inner[name].points, inner[name].faces)[:, 0]))
        clean = bool(settled.moved) and not left and not len(settled.after.vertices)
        where = format_joints(character.skeleton, joints_at(each.corners, mesh, character), MOST_REGIONS)
        yield Finding(
            severity="warning",
            code="garments-cross",
            prim=mesh.path,
            count=len(each.faces),
            found=f"{len(each.faces)} of {len(mesh.faces)} triangles intersect those of {name}, and "
            f"{len(each.beneath)} vertices lie beneath it, up to {1000 * each.depth:.1f} mm deep, at {where}",
            why="garments that start inside each other stay so where they are pinned or tight, in every frame",
            fix="move the outer garment off the inner one in the bind pose; --fix "
            + _does(settled.moved, clean, left),
            fixable=clean,
            elements="faces",
            indices=index_tuple(each.faces),
        )


def _does(moved: int, clean: bool, left: int) -> str:
    """Return in words what settling does to a garment."""
    if clean:
        return "settles it there"
    if not moved:
        return "leaves it as it is, because settling found no shape that is less deep; it may be the inner one"
    return (
        f"leaves {left} triangles that intersect, where no way of at most {1000 * FARTHEST:g} mm leads out; "
        "it may be the inner one"
    )


class _Crossing:
    """What of a garment crosses another one, or lies beneath it.

    Attributes:
        faces: triangles that intersect those of the other, shape (N,).
        beneath: vertices beneath it, shape (M,).
        corners: vertices of either, shape (K,).
        depth: of the deepest of these vertices [m].
    """

    def __init__(self, mesh: Mesh, other: Mesh, body: Mesh) -> None:
        self.faces = np.unique(intersections_between(mesh.points, mesh.faces, other.points, other.faces)[:, 0])
        side = Sheet(other, body).nearest(mesh.points)
        self.beneath = np.flatnonzero(side.inside & vertex_mask(mesh.faces, mesh.vertex_count))
        self.corners = np.union1d(self.beneath, mesh.faces[self.faces].reshape(-1))
        self.depth = float(max(0.0, -side.distance[self.beneath].min(initial=0.0)))

    @property
    def count(self) -> int:
        return len(self.corners)
