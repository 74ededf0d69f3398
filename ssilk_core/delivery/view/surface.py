# SPDX-License-Identifier: Apache-2.0
"""Coloured triangle surfaces, and the geometry that merges all surfaces of a picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ...errors import fail
from ...scene.assets import Floats, Ints

INSIDE_SHADE = 0.75  # brightness of the inside of cloth relative to its outside


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangle mesh to draw.

    Attributes:
        name: for messages.
        points: positions [m], y up, shape (V, 3).
        faces: triangles, counter-clockwise seen from outside, shape (F, 3).
        colour: sRGB in [0, 1], shape (3,) for the whole surface or (V, 3) for each vertex.
        two_sided: True for cloth, whose inside is visible too; False for the skin of a solid.
    """

    name: str
    points: Floats
    faces: Ints
    colour: Floats
    two_sided: bool = False

    def __post_init__(self) -> None:
        points, faces, where = np.asarray(self.points), np.asarray(self.faces), f"surface '{self.name}'"
        if not (points.ndim == 2 and points.shape[1] == 3 and faces.ndim == 2 and faces.shape[1] == 3):
            fail(
                where,
                f"points of shape {points.shape} and faces of shape {faces.shape}",
                "shapes (V, 3) and (F, 3) are needed",
            )
        bad = int(np.count_nonzero(~np.isfinite(points).all(axis=1)))
        if bad != 0:
            fail(where, f"{bad} of {len(points)} points hold NaN or infinity", "all must be finite")
        bad = int(np.count_nonzero((faces < 0) | (faces >= len(points))))
        if bad != 0:
            fail(where, f"{bad} face indices point at no vertex", f"they must lie in 0 to {len(points) - 1}")
        shape = np.shape(self.colour)
        if shape not in ((3,), (len(points), 3)):
            fail(where, f"colours of shape {shape}", f"(3,) or ({len(points)}, 3) is needed")


@dataclass(frozen=True, eq=False)
class Geometry:
    """All surfaces of one picture: float32 arrays over their V vertices and F faces.

    `outside` and `inside` are the linear colours of the two sides, shape (V, 3). `thin` marks the vertices of cloth.
    """

    points: Floats
    faces: Ints
    normals: Floats
    outside: Floats
    inside: Floats
    thin: np.ndarray

    @classmethod
    def of(cls, surfaces: Sequence[Surface]) -> Geometry:
        """Merge surfaces into one geometry, in order."""
        counts = [len(surface.points) for surface in surfaces]
        starts = np.cumsum([0, *counts])
        colours = [np.broadcast_to(linear(s.colour), (n, 3)) for s, n in zip(surfaces, counts)]
        inside = [colour * (INSIDE_SHADE if s.two_sided else 1.0) for s, colour in zip(surfaces, colours)]
        return cls(
            points=_joined([s.points for s in surfaces], np.float32),
            faces=_joined([np.asarray(s.faces) + start for s, start in zip(surfaces, starts)], np.int32),
            normals=_joined([vertex_normals(s.points, s.faces) for s in surfaces], np.float32),
            outside=_joined(colours, np.float32),
            inside=_joined(inside, np.float32),
            thin=np.repeat([s.two_sided for s in surfaces], counts),
        )


def _joined(arrays: Sequence[np.ndarray], dtype: type) -> np.ndarray:
    return np.ascontiguousarray(np.concatenate([np.empty((0, 3)), *arrays]), dtype=dtype)


def linear(colour: ArrayLike) -> Floats:
    """Convert sRGB colours in [0, 1] to linear light, with a power of 2.2."""
    return np.clip(np.asarray(colour, dtype=np.float32), 0.0, 1.0) ** 2.2


def vertex_normals(points: Floats, faces: Ints) -> Floats:
    """Return unit vertex normals, means of the face normals weighted by area, shape (V, 3)."""
    points, faces = np.asarray(points, dtype=np.float64), np.asarray(faces)
    corners = points[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.stack(
        [np.bincount(faces.reshape(-1), np.repeat(cross[:, k], 3), minlength=len(points)) for k in range(3)], axis=1
    )
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0, total / np.where(length > 0, length, 1.0), np.array([0.0, 1.0, 0.0]))
