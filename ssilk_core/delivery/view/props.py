# SPDX-License-Identifier: Apache-2.0
"""Floors and props that the cloth of a shot met, as pictures show them: around the figure, and behind it.

Sets can be of any size. What is further away than a few times the figure's size is left out, and so is what stands
between camera and figure. Large triangles are split, so that light and shadow fall on parts of them. A level floor is
the ground of the picture, unless it is over the figure's feet, as ceilings are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ...physics.world.colliders import placed_at
from ...scene.assets import Collider, Floats, Ints, ShotWorld
from .camera import Camera
from .colours import PROP
from .surface import Surface

REACH = 2.0  # sizes of the figure around its middle that are shown
EDGE = 0.1  # the same, longest edge of a triangle
LEVEL = 1e-3  # [m] between the lowest and the highest point of a level floor
WIDE = 1.5  # sizes of the figure that such a floor measures at least
SUNK = 0.25  # the same, that its lowest point may be under a floor


@dataclass(frozen=True, eq=False)
class ShotProps:
    """The colliders of a shot, and the time of each of its frames in their world [s]."""

    world: ShotWorld
    seconds: Callable[[int], float]

    def ground(self, lowest: float, size: float) -> float | None:
        """Return the height of the level floor that a figure's lowest point is nearest to [m]; None without one.

        Args:
            size: of the figure [m].
        """
        heights = [height for each in self.world.colliders if (height := _level(each, size)) is not None]
        beneath = [height for height in heights if height < lowest + SUNK * size]
        return min(beneath, key=lambda height: abs(height - lowest), default=None)

    def surfaces(self, frame: int, figure: Floats, camera: Camera, ground: float) -> list[Surface]:
        """Return what is shown in a frame around a figure of points (P, 3) [m], but for what is its ground."""
        seconds, found = self.seconds(frame), []
        low, high = figure.min(axis=0), figure.max(axis=0)
        size = float((high - low).max())
        nearest = float(((figure - camera.position) @ camera.axes()[2]).min())
        for collider in self.world.colliders:
            height = _level(collider, size)
            if height is not None and abs(height - ground) < LEVEL:
                continue
            if not (posed := _posed(collider, self.world, seconds)):
                continue
            points, faces = cut_out(*posed, (low + high) / 2, REACH * size, EDGE * size)
            depth = (points - camera.position) @ camera.axes()[2]
            faces = faces[(depth[faces] >= nearest).any(axis=1)]
            if len(faces):
                found.append(Surface(collider.name, points, faces, PROP, two_sided=True))
        return found


def cut_out(points: Floats, faces: Ints, centre: Floats, reach: float, edge: float) -> tuple[Floats, Ints]:
    """Return the triangles (T, 3) of points (P, 3) in a box around a centre (3,), split until no edge is longer.

    Args:
        reach, edge: half a side of the box, and the longest edge [m].
    """
    kept, split = _in_box(points[faces], centre, reach), []
    long = _edges(points[faces]).max(axis=1) > edge
    parts = points[faces[kept & long]]
    while len(parts):
        parts = parts[_in_box(parts, centre, reach)]
        lengths = _edges(parts)
        done = lengths.max(axis=1) <= edge
        split.append(parts[done])
        parts, first = parts[~done], lengths[~done].argmax(axis=1)
        rows = np.arange(len(parts))
        a, b, c = (parts[rows, (first + step) % 3] for step in range(3))  # a to b is longest
        middle = (a + b) / 2
        parts = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
    soup = np.concatenate([np.zeros((0, 3, 3)), *split])
    own = faces[kept & ~long]
    more = len(points) + np.arange(3 * len(soup)).reshape(-1, 3)
    return np.concatenate([points, soup.reshape(-1, 3)]), np.concatenate([own, more])


def _edges(corners: Floats) -> Floats:
    """Return the lengths of the edges from each corner to the next of triangles (T, 3, 3), shape (T, 3)."""
    return np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)


def _in_box(corners: Floats, centre: Floats, reach: float) -> np.ndarray:
    """Return which triangles (T, 3, 3) may reach into a box, shape (T,)."""
    low, high = corners.min(axis=1), corners.max(axis=1)
    return ((low <= centre + reach) & (high >= centre - reach)).all(axis=1)


def _posed(collider: Collider, world: ShotWorld, seconds: float) -> tuple[Floats, Ints] | None:
    """Return the points (P, 3) and the triangles of a collider at a time; None where it is not there then."""
    if not collider.is_there(world.fps, seconds):
        return None
    place = placed_at(collider.placements, world, seconds)
    points = world.between(collider.points, seconds)
    return points @ place[:3, :3].T + place[:3, 3], collider.faces


def _level(collider: Collider, size: float) -> float | None:
    """Return the height of a wide and level floor that stays [m]; None where a collider is none."""
    if len(collider.points) > 1 or len(collider.placements) > 1 or not collider.present.all():
        return None
    place = collider.placements[0]
    points = (collider.points[0] @ place[:3, :3].T + place[:3, 3])[np.unique(collider.faces)]
    across, along = np.ptp(points[:, 0]), np.ptp(points[:, 2])
    flat = np.ptp(points[:, 1]) < LEVEL and min(across, along) > WIDE * size
    return float(points[:, 1].mean()) if flat else None
