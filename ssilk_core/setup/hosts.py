# SPDX-License-Identifier: Apache-2.0
"""What lies on other islands of its garment follows them: carried parts wholly, others near their stitches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..assets import Floats, Ints, Mesh
from ..mesh.geodesic import nearest_sources
from ..mesh.stitches import SAME_PLACE, Stitches, find_carried, find_feet, joined_islands, joined_mesh, touching
from ..mesh.topology import islands, vertex_mask

Mask = NDArray[np.bool_]
BLEND = 0.03  # [m] along a strap over which its weights turn from its host's to its own


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
        return cls(mesh, touching(mesh, feet), find_carried(mesh, feet))

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

        Elsewhere `loose` (V,) vertices, all by default, that are not carried turn to the weights of the point under
        the nearest stitch, by the difference there times exp(-(d/r)^2), with their distance d along their island.
        """
        if not len(self.stitches):
            return rows
        result = np.array(rows)
        free = ~vertex_mask(self.feet.vertices, len(rows)) & (True if loose is None else loose)
        sewn = self.stitches
        sewn = sewn.select(sewn.on_larger & (sewn.distance > SAME_PLACE) & free[sewn.vertices])
        if len(sewn):
            difference = np.zeros_like(result)
            difference[sewn.vertices] = _under(sewn, result) - result[sewn.vertices]
            distance, nearest = nearest_sources(self.mesh.points, self.mesh.faces, sewn.vertices)
            near = np.flatnonzero(free & (distance < 3 * BLEND))
            share = np.exp(-((distance[near] / BLEND) ** 2))
            turned = (result[near] + share[:, None] * difference[nearest[near]]).clip(0)
            result[near] = turned / turned.sum(axis=1, keepdims=True)
        for part in self._by_island():
            result[part.vertices] = _under(part, result)
        return result

    def _by_island(self) -> list[Stitches]:
        """Return the feet of each carried island, hosts first."""
        island = islands(self.mesh.faces, self.mesh.vertex_count)[self.feet.vertices]
        parts = np.split(np.arange(len(island)), np.flatnonzero(np.diff(island)) + 1)
        return [self.feet.select(part) for part in parts if len(part)]


def _under(stitches: Stitches, rows: Floats) -> Floats:
    """Return the rows (V, J) of the points under stitched vertices, shape (S, J)."""
    return np.einsum("sk,skj->sj", stitches.shares, rows[stitches.corners])
