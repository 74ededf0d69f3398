# SPDX-License-Identifier: Apache-2.0
"""What lies on other islands of its garment follows them: carried parts wholly, others near their stitches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...errors import fail
from ...scene.assets import LOOSE, Floats, Ints, Mesh
from ...scene.fabrics import Fabric
from ...scene.mesh.stitches import (
    SAME_PLACE,
    Stitches,
    find_carried,
    find_feet,
    find_stitches,
    joined_islands,
    joined_mesh,
    touching,
)
from ...scene.mesh.topology import adrift, edges, islands, vertex_areas, vertex_mask
from .binding import laplacian

Mask = NDArray[np.bool_]
FADING = 0.1  # [m] r, over which the weights of a strap turn from its host's to its own
TINY = 1e-15  # [m2]; keeps vertices without area from making the equations singular


@dataclass(frozen=True, eq=False)
class Hosts:
    """What holds the islands of a garment that lie on others.

    Attributes:
        mesh: the garment at rest.
        stitches: all of them.
        feet: of the vertices that are carried, in an order in which hosts come before what they carry.
    """

    mesh: Mesh
    stitches: Stitches
    feet: Stitches

    @classmethod
    def of(cls, mesh: Mesh) -> Hosts:
        """Return those of a garment; a garment of one island has none."""
        feet = find_feet(mesh)
        carried = find_carried(mesh, feet)
        return cls(mesh, touching(mesh, feet, carried), carried)

    @property
    def joined_islands(self) -> Ints:
        """The islands of the garment, where those on one another count as one, shape (V,)."""
        return joined_islands(self.mesh, self.stitches)

    @property
    def joined_mesh(self) -> Mesh:
        """The garment with edges along the stitches."""
        return joined_mesh(self.mesh, self.stitches)

    def carry(self, values: NDArray) -> NDArray:
        """Return values of vertices (V,), where carried ones have those of the nearest vertices of their hosts."""
        result = np.array(values)
        for part in self._by_island():
            result[part.vertices] = result[part.nearest]
        return result

    def blend(self, rows: Floats, loose: Mask | None = None) -> Floats:
        """Return weights (V, J) where carried vertices have those of the points under them.

        Stitched vertices that are `loose` (V,), all by default, and not carried have these too. From them the
        difference fades over the rest of their islands, by the screened Poisson equation (laplace u = u / r^2), to
        none at vertices that are not loose.
        """
        if not len(self.stitches):
            return rows
        result = np.array(rows)
        free = ~vertex_mask(self.feet.vertices, len(rows)) & (True if loose is None else loose)
        sewn = self.stitches
        sewn = sewn.select(sewn.on_larger & (sewn.distance > SAME_PLACE) & free[sewn.vertices])
        if len(sewn):
            turned = (result + self._faded(sewn, _under(sewn, result) - result[sewn.vertices], free)).clip(0)
            changed = (turned != result).any(axis=1)
            result[changed] = turned[changed] / turned[changed].sum(axis=1, keepdims=True)
        for part in self._by_island():
            result[part.vertices] = _under(part, result)
        return result

    def _faded(self, sewn: Stitches, difference: Floats, free: Mask) -> Floats:
        """Return differences (V, J) that are given at stitches (S, J) and fade over the `free` (V,) vertices."""
        from scipy.sparse import diags
        from scipy.sparse.linalg import splu

        mesh = self.mesh
        island = islands(mesh.faces, mesh.vertex_count)
        areas = vertex_areas(mesh.points, mesh.faces)
        result = np.zeros((mesh.vertex_count, difference.shape[1]))
        result[sewn.vertices] = difference
        inner = free & np.isin(island, island[sewn.vertices])
        inner[sewn.vertices] = False
        if inner.any():
            matrix = laplacian(mesh.points, areas, edges(mesh.faces))[inner]
            screened = matrix[:, inner] + diags(areas[inner] / FADING**2 + TINY)
            result[inner] = splu(screened.tocsc()).solve(-(matrix @ result))
        return result

    def _by_island(self) -> list[Stitches]:
        """Return the feet of each carried island, hosts first."""
        island = islands(self.mesh.faces, self.mesh.vertex_count)[self.feet.vertices]
        parts = np.split(np.arange(len(island)), np.flatnonzero(np.diff(island)) + 1)
        return [self.feet.select(part) for part in parts if len(part)]


def need_stitch(mesh: Mesh, classes: Ints, fabric: Fabric) -> None:
    """Raise `SsilkError` where the fabric has no stitch and islands that are all loose (V,) need one to hold them."""
    if fabric.stitch:
        return
    island = islands(mesh.faces, mesh.vertex_count)
    falling = adrift(mesh.faces, island, classes != LOOSE)
    if len(falling) and len(find_stitches(mesh)):
        fail(
            mesh.path,
            f"{len(falling)} of {len(np.unique(island[mesh.faces]))} islands are all loose, held by stitches alone, "
            f"and the fabric '{fabric.name}' has stitch = 0",
            "they would fall off",
            f"give --material stitch={Fabric('default').stitch:g}, or paint a part of each as pinned or tight",
        )


def _under(stitches: Stitches, rows: Floats) -> Floats:
    """Return the rows (V, J) of the points under stitched vertices, shape (S, J)."""
    return np.einsum("sk,skj->sj", stitches.shares, rows[stitches.corners])
