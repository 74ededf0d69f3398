# SPDX-License-Identifier: Apache-2.0
"""The body and garments on it as one surface, off which a garment over them is settled.

A garment is a sheet with borders, and what lies beneath it is on its wrong side. The side is that away from the body,
as contact has it in training (`collision.inner_cloth`): a point is beneath a sheet where it is on the side of the
skin, at most `DEEPEST` from it, and not past a border. Of the body and all garments, a point belongs to what it is
deepest in, or else nearest to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...scene.assets import Floats, Mesh
from ...scene.mesh.joined import joined
from ...scene.mesh.topology import edge_use, merged_places
from ..setup.surface import closest_on_surface
from .mesh import distinct_faces
from .sides import OuterSurface, SurfaceSide, oriented

Mask = NDArray[np.bool_]
DEEPEST = 0.04  # [m] beneath a sheet, from which on cloth may belong to the other side of a limb or a fold
PAST = 0.5  # sine of the angle between a sheet and the way from its border, below which a point lies past it
ON_EDGE = 1e-6  # barycentric coordinate below which a point lies on the opposite edge


class LayeredSurface:
    """The surface of a body, and of garments on it; what it says is as `OuterSurface` says it.

    Args:
        inner: the garments in the bind pose.
    """

    def __init__(self, body: Mesh, inner: Sequence[Mesh]) -> None:
        self.skin = OuterSurface(body)
        self.sheets = [Sheet(garment, self.skin.whole) for garment in inner]
        whole = joined([self.skin.mesh, *(sheet.mesh for sheet in self.sheets)])
        assert whole is not None
        self.mesh = whole

    def inside(self, points: Floats) -> Mask:
        """Return whether points (S, 3) lie in the body or beneath a garment, shape (S,)."""
        found = self.skin.inside(points)
        for sheet in self.sheets:
            found = found | sheet.nearest(points).inside
        return found

    def nearest(self, points: Floats) -> SurfaceSide:
        """Return the points of the surface that points (S, 3) are deepest in or nearest to."""
        return self._deepest(self.skin.nearest(points), points)

    def belonging(self, points: Floats, inside: Mask, facing: Floats, doubtful: Mask, crossed: Mask) -> SurfaceSide:
        """Return likewise those that cloth belongs to, from what `OuterSurface.belonging` takes."""
        in_body = np.zeros(len(points), dtype=bool)
        in_body[inside] = self.skin.inside(points[inside])
        return self._deepest(self.skin.belonging(points, in_body, facing, doubtful, crossed), points)

    def _deepest(self, side: SurfaceSide, points: Floats) -> SurfaceSide:
        for sheet in self.sheets:
            own = sheet.nearest(points)
            deeper = own.distance < side.distance
            side = SurfaceSide(
                np.where(deeper[:, None], own.normals, side.normals),
                np.where(deeper[:, None], own.points, side.points),
                side.inside | own.inside,
                np.where(deeper, own.distance, side.distance),
            )
        return side


class Sheet:
    """A garment in the bind pose, wound to be seen from outside the body."""

    def __init__(self, garment: Mesh, body: Mesh) -> None:
        from ...physics.collision.inner_cloth import turned_away

        faces = turned_away(garment, body)
        self.mesh = replace(garment, faces=faces, polygon_counts=None, polygon_indices=None, uvs=None)
        place = merged_places(garment.points)
        pairs, uses = edge_use(distinct_faces(place[faces]))
        self._border = np.isin(place, pairs[uses == 1])

    def nearest(self, points: Floats) -> SurfaceSide:
        """Return the nearest points of the sheet to points (S, 3), and those beneath it as inside."""
        found = closest_on_surface(points, self.mesh)
        at = np.einsum("sk,skc->sc", found.barycentric, self.mesh.points[found.corners])
        height = np.einsum("sc,sc->s", points - at, found.normals)
        at_border = (self._border[found.corners] | (found.barycentric < ON_EDGE)).all(axis=1)
        past = at_border & (np.abs(height) < PAST * found.distance)
        beneath = (height < 0) & (found.distance < DEEPEST) & ~past
        return oriented(points, found.normals.copy(), at, beneath, found.distance)
