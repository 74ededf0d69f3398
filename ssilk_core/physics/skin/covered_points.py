# SPDX-License-Identifier: Apache-2.0
"""Points of the skin that a garment covers in the bind pose, and what cloth lies before and beneath them.

Whatever tells the skin that shows asks `CoveredPoints.states`, with the posed meshes of a written file or with those
of a network. The points at which skin is judged are drawn at random, each within its own part of the surface, and are
looked at along the normals of their triangles. Refinement lifts cloth at other points, along smooth normals
(`refine.clearing`). At its own it would bring down the figure, and leave skin between them that is seen.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from ...scene.assets import Floats, Ints, Mesh
from ...scene.mesh import topology
from ..collision import RayCaster
from .blocked_rays import NO_TRIANGLE, BlockedRays
from .figures import COVER_REACH, SHOW_DEPTH

SKIN_POINTS, SEED = 8000, 1  # of the points at which skin is judged
MORTON_BITS = 12  # cells of half a millimetre on a person
PLASTIC = 1.32471795724474602596  # root of x^3 = x + 1; its powers make the most even sequence in the plane


@dataclass(frozen=True, eq=False)
class SkinStates:
    """Which covered points show, and which are bare, both bool (P, N), and which limbs pierce the cloth, bool (L, N).

    Nothing is known of limbs by default.
    """

    shows: Tensor
    bare: Tensor
    pierced: Tensor | None = None


class CoveredPoints:
    """Evenly spread points of a body that cloth covers in the bind pose.

    Args:
        body, cloth: in the bind pose.
        count: points on the whole body.
        seed: of their places; None for a regular pattern.
        smooth: whether normals are those between the vertices', or the triangles' own.

    Attributes:
        faces: the triangle of the body that each covered point lies on, shape (P,).
        weights: its barycentric coordinates there, shape (P, 3).
        vertices: vertices of the body at the corners of these triangles, shape (C,).
        device: where frames are looked at.
    """

    def __init__(
        self,
        body: Mesh,
        cloth: Mesh,
        *,
        count: int = SKIN_POINTS,
        seed: int | None = SEED,
        smooth: bool = False,
        device: torch.device,
    ) -> None:
        faces, weights = spread_points(body, count, seed)
        covered = _covered(body, faces, weights, cloth, smooth)
        self.cloth, self.faces, self.weights = cloth, faces[covered], weights[covered]
        self.vertices, place = np.unique(body.faces[self.faces], return_inverse=True)
        self._corners = torch.as_tensor(place.reshape(-1, 3), device=device)
        self._weights = torch.as_tensor(self.weights, dtype=torch.float32, device=device)[..., None, None]
        self.device = device

    def __len__(self) -> int:
        return len(self.faces)

    def place(self, points: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
        """Return the points [m] and unit normals, both (P, 3, N), on a body with these at `vertices` (C, 3, N)."""
        return _mean(points[self._corners], self._weights), _unit(_mean(normals[self._corners], self._weights))

    def outermost(self, x: Tensor, points: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
        """Return the signed distance of the outermost cloth at points placed so [m], and its triangle, both (P, N).

        The distance is minus infinity where no cloth is within reach, above or beneath.
        """
        return self._caster.outermost(points, normals, x, above=COVER_REACH, beneath=SHOW_DEPTH)

    @torch.no_grad()
    def states(self, x: Tensor, body: Tensor) -> SkinStates:
        """Tell which points show, and which are bare; all show in a frame where the cloth is not finite.

        Args:
            x: vertices of the cloth [m], shape (V, 3, N).
            body: points of the body at `vertices`, in the same frames [m], shape (C, 3, N).
        """
        x, corners = x.float(), body.float()[self._corners]
        points = _mean(corners, self._weights)
        normals = _unit(torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], dim=1))
        finite = x.isfinite().all(0).all(0)
        if x.is_cuda:
            hits = self._caster.cast(points, normals, x, above=COVER_REACH, beneath=SHOW_DEPTH)
            covered, near = hits.above, hits.above | hits.beneath
        else:
            covered, near = (torch.zeros(len(self), x.shape[2], dtype=torch.bool) for _ in range(2))
            for frame in finite.nonzero()[:, 0].tolist():
                asked = (np.ascontiguousarray(values[..., frame].numpy()) for values in (x, points, normals))
                for found, told in zip((covered, near), self._rays.look(*asked)):
                    found[:, frame] = torch.from_numpy(told)
        return SkinStates((near & ~covered) | ~finite, ~near & finite)

    @cached_property
    def _caster(self) -> RayCaster:
        return RayCaster(self.cloth, device=self.device)

    @cached_property
    def _rays(self) -> LastingRays:
        return LastingRays(self.cloth, len(self))


class LastingRays:
    """Rays of points that meet mostly the same cloth from frame to frame, by `BlockedRays`.

    A processor takes half of the time that products of matrices take it.
    """

    def __init__(self, cloth: Mesh, count: int) -> None:
        self._search, self._last = BlockedRays(cloth.points, cloth.faces), np.full(count, NO_TRIANGLE)

    def look(self, x: Floats, points: Floats, normals: Floats) -> tuple[np.ndarray, np.ndarray]:
        """Return which points have cloth within reach above, and which above or beneath, both bool (P,)."""
        low, high = (np.full(len(points), reach, dtype=points.dtype) for reach in (-SHOW_DEPTH, COVER_REACH))
        found, distance = self._search.find(x, points, normals, low, high, self._last)
        near = found != NO_TRIANGLE
        covered = near & (distance >= 0)
        beneath = np.flatnonzero(near & ~covered)  # other cloth may be above
        nothing, unknown = np.zeros(len(beneath), dtype=points.dtype), np.full(len(beneath), NO_TRIANGLE)
        asked = points[beneath], normals[beneath], nothing, high[beneath], unknown
        above, _ = self._search.find(x, *asked)
        covered[beneath] = above != NO_TRIANGLE
        found[beneath] = np.where(covered[beneath], above, found[beneath])
        self._last = np.where(near, found, self._last)
        return covered, near


def _mean(corners: Tensor, weights: Tensor) -> Tensor:
    """Return the means (P, 3, N) of values at corners (P, 3, 3, N) with weights (P, 3, 1, 1)."""
    return (corners * weights).sum(1)


def _unit(vectors: Tensor) -> Tensor:
    return vectors / vectors.norm(dim=1, keepdim=True).clamp_min(1e-12)


def _covered(mesh: Mesh, faces: Ints, weights: Floats, cloth: Mesh, smooth: bool) -> np.ndarray:
    """Tell above which points of the body cloth lies in the bind pose, bool (P,)."""
    corners = mesh.points[mesh.faces[faces]]
    points = (corners * weights[..., None]).sum(1)
    directions = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    if smooth:
        normals = topology.vertex_normals(mesh.points, mesh.faces)
        directions = (normals[mesh.faces[faces]] * weights[..., None]).sum(1)
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True).clip(1e-12)
    asked = (torch.from_numpy(values)[:, :, None] for values in (points, directions, cloth.points.copy()))
    caster = RayCaster(cloth, device=torch.device("cpu"))
    return caster.cast(*asked, above=COVER_REACH, beneath=0.0).above[:, 0].numpy()


def _cells(points: Floats) -> Ints:
    """Return the places of points (P, 3) on a Morton curve, along which neighbours mostly lie close together."""
    low = points.min(axis=0)
    cells = ((points - low) / max(float(np.ptp(points, axis=0).max()), 1e-9) * (2**MORTON_BITS - 1)).astype(np.int64)
    return sum(((cells[:, axis] >> bit) & 1) << (3 * bit + axis) for bit in range(MORTON_BITS) for axis in range(3))


def spread_points(mesh: Mesh, count: int, seed: int | None = None) -> tuple[Ints, Floats]:
    """Spread points evenly by area over a mesh, always in the same way for one seed.

    The surface is cut into so many parts of equal area, along a path through triangles that lie close together. The
    point of each is at random within its part, or without a seed on the triangle in its middle, where points on one
    triangle follow a sequence of low discrepancy.

    Returns:
        The triangle of each point (P,), and its barycentric coordinates (P, 3).
    """
    path = np.argsort(_cells(mesh.points[mesh.faces].mean(axis=1)), kind="stable")
    ends = np.cumsum(topology.face_areas(mesh.points, mesh.faces)[path])
    number = np.arange(count)
    if seed is None:
        part, u, v = 0.5, *((0.5 + (number + 1) / PLASTIC**power) % 1 for power in (1, 2))
    else:
        part, u, v = np.random.default_rng(seed).random((3, count))
    place = np.searchsorted(ends, (number + part) / count * ends[-1], side="right")
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)  # the square's other half, turned onto it
    return path[place.clip(max=len(path) - 1)], np.stack([1 - u - v, u, v], axis=1)
