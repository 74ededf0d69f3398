# SPDX-License-Identifier: Apache-2.0
"""Light: one soft key lamp that casts ray-traced shadows, and a sky whose reach to each vertex is ray-traced too.

The sky is sampled along directions fixed in the world. Visibility is found once for each vertex and interpolated
over faces, which is free of noise and does not flicker from frame to frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...scene.assets import UP, Floats
from .camera import Camera
from .surface import Geometry
from .trace import Tracer

SKY_RAYS = 48  # directions over the entire sphere
LAMP_RAYS = 16  # points of the lamp, one per position in a tile of 4 x 4 samples
LAMP_RADIUS = np.tan(np.radians(1.8))
KEY = np.array([1.02, 0.98, 0.93], dtype=np.float32)
RIM = np.array([0.20, 0.22, 0.26], dtype=np.float32)
ZENITH, HORIZON, FLOOR = (
    np.array(rgb, dtype=np.float32) for rgb in ([0.66, 0.70, 0.78], [0.36, 0.37, 0.40], [0.17, 0.165, 0.16])
)
OFFSET = 1e-3  # rays start this far off the surface [m], past the error of float32


@dataclass(frozen=True, eq=False)
class Lighting:
    """Unit directions to the lamps `key` and `rim`, shape (3,), and to sample points of the key lamp, (16, 3)."""

    key: Floats
    rim: Floats
    lamp: Floats

    @classmethod
    def for_camera(cls, camera: Camera) -> Lighting:
        """Return lamps for a camera: the key light above its left side, and the rim light behind on the right."""
        right = camera.axes()[0]
        level = np.cross(UP, right)  # into the picture
        key = _unit(1.3 * UP - 1.0 * right - 0.75 * level)
        rim = _unit(0.55 * UP + 0.7 * right + 0.8 * level)
        return cls(key.astype(np.float32), rim.astype(np.float32), _disc_around(key).astype(np.float32))


def _unit(vectors: Floats) -> Floats:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _disc_around(axis: Floats) -> Floats:
    """Return directions spread evenly over a small disc around an axis (a sunflower), shape (16, 3)."""
    across = _unit(np.cross(axis, UP))
    steps = np.arange(LAMP_RAYS)
    radius, angle = LAMP_RADIUS * np.sqrt((steps + 0.5) / LAMP_RAYS), steps * np.pi * (3 - np.sqrt(5))
    # A stride of 7 scatters the spiral, so that consecutive samples are spread over the disc.
    order = steps * 7 % LAMP_RAYS
    offsets = (radius * np.cos(angle))[order, None] * across + (radius * np.sin(angle))[order, None] * np.cross(
        axis, across
    )
    return _unit(axis + offsets)


def sky_directions(count: int) -> Floats:
    """Return unit directions spread evenly over the sphere (a Fibonacci lattice), float32, shape (count, 3)."""
    steps = np.arange(count)
    height = 1 - (2 * steps + 1) / count
    angle, radius = steps * np.pi * (3 - np.sqrt(5)), np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(angle), height, radius * np.sin(angle)], axis=1).astype(np.float32)


def sky_radiance(directions: Floats) -> Floats:
    """Return the light from the sky and, from below, from the floor, shape (N, 3)."""
    height = directions[:, 1:2]
    return np.where(height > 0, HORIZON + (ZENITH - HORIZON) * np.clip(height, 0, 1), FLOOR)


def sky_light(tracer: Tracer, points: Floats, normals: Floats, thin: np.ndarray) -> tuple[Floats, Floats]:
    """Return the sky's light on the outside and on the inside of vertices, each (V, 3).

    It is the cosine-weighted mean over the unoccluded hemisphere of each side. The insides of vertices that are not
    `thin` are never visible and stay dark.
    """
    directions = sky_directions(SKY_RAYS)
    cosine = normals @ directions.T
    vertex, ray = np.nonzero((cosine > 0) | thin[:, None])
    side = np.sign(cosine[vertex, ray])[:, None] * OFFSET
    free = np.zeros(cosine.shape, dtype=bool)
    free[vertex, ray] = ~tracer.blocked(points[vertex] + side * normals[vertex], directions[ray])
    seen = np.where(free, cosine, 0)
    # The mean of max(cosine, 0) over the sphere is 1/4.
    radiance = sky_radiance(directions) * np.float32(4 / SKY_RAYS)
    return np.maximum(seen, 0) @ radiance, np.maximum(-seen, 0) @ radiance


@dataclass(frozen=True, eq=False)
class LitGeometry:
    """A geometry with the sky's light on both sides of its vertices, ready for shading."""

    geometry: Geometry
    tracer: Tracer
    sky_outside: Floats
    sky_inside: Floats

    @classmethod
    def of(cls, geometry: Geometry) -> LitGeometry:
        """Compute the sky's light on every vertex of a geometry."""
        tracer = Tracer(geometry)
        return cls(geometry, tracer, *sky_light(tracer, geometry.points, geometry.normals, geometry.thin))
