# SPDX-License-Identifier: Apache-2.0
"""Rays from cloth through the body beneath it: how much of a limb the cloth encloses, and whether it spans two.

Cloth around a limb of its own is met all around that limb. Cloth around two of them, such as a skirt below the
crotch, is met behind the other limb, or behind the air between both.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...scene.assets import UP, Body, Character, Floats, Ints, Mesh
from ...scene.mesh.topology import edges, smooth
from .surface import SurfacePoints

if TYPE_CHECKING:
    from igl import AABB

Mask = NDArray[np.bool_]
CROSSINGS = 4  # of the body's surface that are followed along a ray
STEP = 1e-5  # [m] behind a surface, from where its next crossing is looked for
# Tangents of the angles by which rays lean: those that tell how much is enclosed, and those that look for limbs
# beside, across the vertical, as legs stand.
ENCLOSING = ((0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))
ACROSS = tuple((side, up) for side in (-2.0, -1.0, -0.4, 0.0, 0.4, 1.0, 2.0) for up in (-0.3, 0.3))
GAP = 0.02  # [m] of air between two limbs that part, at least; at a crotch they touch
AIR = 0.1  # [m] of air between a limb and the cloth of another one, at least
ROUNDS, MOSTLY = 12, 0.5  # of averaging over neighbours; above the seam of a crotch a few rays find the other limb
SAME_LIMB = 0.25  # least common share of weights on two sides of one limb
TILT = (1.3e-3, -0.7e-3, 1.1e-3)  # tilts rays off the axes, where they slip through edges of regular meshes


@dataclass(frozen=True, eq=False)
class LimbRays:
    """What rays from each vertex into the body find.

    Attributes:
        corners: vertices of the cloth that the first rays meet, one against the normal of the body and four at
            45 degrees to it, shape (5, V, 3), -1 where they meet none.
        parting: whether rays leave one limb and find another one, or its cloth, before any other, shape (V,).
    """

    corners: Ints
    parting: Mask

    def hits(self, near: Mask) -> Floats:
        """Return the share of rays that meet `near` (V,) cloth on the other side, shape (V,)."""
        met = (self.corners >= 0).all(axis=-1)
        return np.mean(met & near[self.corners].all(axis=-1), axis=0)

    @classmethod
    def through(cls, character: Character, mesh: Mesh, body: SurfacePoints, thickness: float) -> LimbRays:
        """Cast the rays; each looks for cloth behind the first `thickness` [m] of it."""
        import igl

        normals, merged = body.normals, character.merged_body()
        weights = merged.skin.dense(character.skeleton.joint_count)
        own = np.einsum("vk,vkj->vj", body.barycentric, weights[body.corners])
        cloth, solid = igl.AABB(), igl.AABB()
        cloth.init(mesh.points, mesh.faces)
        solid.init(merged.mesh.points, merged.mesh.faces)

        def behind(origins: Floats, rays: Floats) -> Ints:
            """Return the triangle of the cloth that each ray meets, -1 where it meets none, shape (V,)."""
            met, _, _ = cloth.intersect_ray_first(mesh.points, mesh.faces, origins + thickness * rays, rays)
            return met

        under = np.einsum("vk,vkc->vc", body.barycentric, merged.mesh.points[body.corners]) - STEP * normals
        corners, count = [], np.zeros(mesh.vertex_count, dtype=int)
        for rays in _rays(normals, np.eye(3)[np.abs(normals).argmin(axis=1)], ENCLOSING):
            face = behind(mesh.points, rays)
            corners.append(np.where(face[:, None] >= 0, mesh.faces[face], -1))
        for rays in _rays(normals, UP, ACROSS):
            face = behind(under, rays)
            far = np.flatnonzero((face >= 0) & _strange(own, own[mesh.faces[face]].mean(axis=1)))
            if len(far):
                count[far] += _parting(mesh, own, merged, weights, (cloth, solid), under[far], rays[far], own[far])
        shares = smooth((count > 0)[:, None].astype(float), edges(mesh.faces), ROUNDS)[:, 0]
        return cls(np.array(corners), shares > MOSTLY)


def _rays(normals: Floats, axis: Floats, leans: Sequence[tuple[float, float]]) -> Iterator[Floats]:
    """Yield unit rays against normals (V, 3), inclined by each pair of tangents: across an axis, and along it."""
    across = np.cross(normals, axis)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    along = np.cross(normals, across)
    for side, up in leans:
        rays = side * across + up * along - normals + TILT
        yield rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)


def _strange(own: Floats, other: Floats) -> Mask:
    """Return where weights (V, J) belong to different limbs, shape (V,)."""
    return np.minimum(own, other).sum(axis=1) < SAME_LIMB


def _parting(
    mesh: Mesh,
    cloth_weights: Floats,
    body: Body,
    weights: Floats,
    trees: tuple[AABB, AABB],
    origins: Floats,
    rays: Floats,
    own: Floats,
) -> Mask:
    """Return which rays (N, 3) from under the skin (N, 3) enter another limb, or meet its cloth behind air, (N,).

    Args:
        cloth_weights, weights, own: of the skin beneath the cloth (V, J), of the body, of where rays begin (N, J).
        trees: of the cloth and of the body.
    """
    left, entered, at = _crossings(body.mesh, trees[1], origins, rays)
    begun = np.where(np.isfinite(left), np.maximum(left - GAP, 0), 0)  # cloth may lie in the skin
    face, reach, _ = trees[0].intersect_ray_first(mesh.points, mesh.faces, origins + begun[:, None] * rays, rays)
    limit = np.where((face >= 0) & np.isfinite(left), begun + reach, -np.inf)
    inside, apart = at < limit, (at >= limit) & (limit - left > AIR)
    there = np.where(
        inside[:, None],
        weights[body.mesh.faces[entered]].mean(axis=1),
        cloth_weights[mesh.faces[face]].mean(axis=1),
    )
    return (inside | apart) & _strange(own, there)


def _crossings(body: Mesh, tree: AABB, origins: Floats, rays: Floats) -> tuple[Floats, Ints, Floats]:
    """Return how far along each ray the body is left for air, and in which triangle and how far it is entered again.

    Each has the shape (V,); distances are infinite where it is not.
    """
    normals = np.cross(*(body.points[body.faces[:, corner]] - body.points[body.faces[:, 0]] for corner in (1, 2)))
    travelled, left, at = np.zeros(len(origins)), *np.full((2, len(origins)), np.inf)
    entered = np.full(len(origins), -1)
    for _ in range(CROSSINGS):
        begun = origins + travelled[:, None] * rays
        face, reach, _ = tree.intersect_ray_first(body.points, body.faces, begun, rays)
        there = (face >= 0) & (entered < 0)
        travelled = travelled + np.where(there, reach, 0.0)
        outward = np.einsum("vc,vc->v", normals[face], rays) > 0
        again = there & ~outward & (travelled > left + GAP)
        entered, at = np.where(again, face, entered), np.where(again, travelled, at)
        left = np.where(there & ~outward & ~again, np.inf, left)  # no air, or hardly any
        left = np.where(there & outward & ~np.isfinite(left), travelled, left)
        travelled = travelled + STEP
    return left, entered, at
