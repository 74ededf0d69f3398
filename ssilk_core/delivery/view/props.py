# SPDX-License-Identifier: Apache-2.0
"""Floors and props that the cloth of a shot met, as pictures show them: around the figure, and behind it.

Sets can be of any size. What is further away than a few times the figure's size is left out; of parts that are larger
than that, what is nearer is shown, cut straight. Where much of the figure is hidden in a frame of a shot, what hides
it is cut in all of its frames by a plane before the figure: of a room the near walls are missing, and a box beside
the figure or before its feet is whole. Large triangles are split, so that light and shadow fall on parts of them. A
level floor is the ground of the picture, unless it is over the figure's feet, as ceilings are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ...physics.world.colliders import placed_at
from ...scene.assets import Collider, Floats, Ints, ShotWorld
from ...scene.mesh.topology import islands, merged_places
from .camera import Camera
from .colours import PROP
from .cut import cut_by_plane, cut_to_box, edge_lengths, split
from .surface import Surface

REACH = 2.0  # sizes of the figure around its middle that are shown
EDGE = 0.1  # the same, longest edge of a triangle
LEVEL = 1e-3  # [m] between the lowest and the highest point of a level floor
WIDE = 1.5  # sizes of the figure that such a floor measures at least
SUNK = 0.25  # the same, that its lowest point may be under a floor
MOST_HIDDEN = 0.5  # share of the rectangle around the figure
CELLS = 16  # along a side of this rectangle, in which is counted what hides it
NEAREST = 1e-2  # [m] from the camera to what hides something


@dataclass(frozen=True, eq=False)
class FigureBox:
    """The box around a figure in a frame, corners `low` and `high` [m], shape (3,)."""

    low: Floats
    high: Floats

    @classmethod
    def of(cls, points: Floats) -> FigureBox:
        """Return that of points (P, 3)."""
        return cls(points.min(axis=0), points.max(axis=0))

    @property
    def size(self) -> float:
        return float((self.high - self.low).max())

    @property
    def corners(self) -> Floats:
        """Shape (8, 3)."""
        pick = np.indices((2, 2, 2)).reshape(3, 8)
        return np.stack([self.low, self.high])[pick, np.arange(3)[:, None]].T

    def depth(self, camera: Camera) -> float:
        """Return how far before a camera it begins [m]."""
        return float(((self.corners - camera.position) @ camera.axes()[2]).min())


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
        heights = [height for each in self.world.colliders if (height := level(each, size)) is not None]
        beneath = [height for height in heights if height < lowest + SUNK * size]
        return min(beneath, key=lambda height: abs(height - lowest), default=None)

    @cached_property
    def parts(self) -> tuple[Ints, ...]:
        """The connected part of each triangle (T,) of each collider; what lies on the same place is connected."""
        found = []
        for each in self.world.colliders:
            place = merged_places(each.points[0])
            found.append(islands(place[each.faces], len(place))[place[each.faces[:, 0]]])
        return tuple(np.unique(each, return_inverse=True)[1].reshape(-1) for each in found)

    def posed(self, number: int, frame: int) -> Floats | None:
        """Return the points (P, 3) of a collider in a frame [m]; None where it is not there then."""
        collider, seconds = self.world.colliders[number], self.seconds(frame)
        if not collider.is_there(self.world.fps, seconds):
            return None
        place = placed_at(collider.placements, self.world, seconds)
        return self.world.between(collider.points, seconds) @ place[:3, :3].T + place[:3, 3]

    def in_the_way(
        self, figures: Sequence[FigureBox], cameras: Sequence[Camera], frames: Sequence[int]
    ) -> dict[int, NDArray[np.bool_]]:
        """Return the parts of colliders, by number, that hide the figure where much of it is hidden in a frame."""
        found = {number: np.zeros(_count(part), dtype=bool) for number, part in enumerate(self.parts)}
        for figure, camera, frame in zip(figures, cameras, frames):
            covers = {}
            for number, collider in enumerate(self.world.colliders):
                if (points := self.posed(number, frame)) is not None:
                    covers[number] = _covers(points[collider.faces], self.parts[number], figure, camera)
            hidden = [each.any(axis=0) for each in covers.values()]
            if hidden and np.logical_or.reduce(hidden).mean() > MOST_HIDDEN:
                for number, each in covers.items():
                    found[number] |= each.any(axis=(1, 2))
        return found

    def surfaces(
        self,
        frame: int,
        figure: FigureBox,
        camera: Camera,
        ground: float,
        in_the_way: dict[int, NDArray[np.bool_]],
    ) -> list[Surface]:
        """Return what is shown in a frame around a figure, but for what is its ground.

        Args:
            in_the_way: as the method has it, for all frames of the shot.
        """
        found, size = [], figure.size
        for number, collider in enumerate(self.world.colliders):
            height = level(collider, size)
            if height is not None and abs(height - ground) < LEVEL:
                continue
            if (points := self.posed(number, frame)) is None:
                continue
            shown = _around(points, collider.faces, self.parts[number], figure, camera, in_the_way[number])
            if len(shown[1]):
                found.append(Surface(collider.name, *shown, PROP, two_sided=True))
        return found


def near_parts(corners: Floats, part: Ints, low: Floats, high: Floats) -> NDArray[np.bool_]:
    """Return which parts (N,) of triangles (T, 3, 3) reach into a box, corners `low` and `high` (3,).

    Args:
        part: of each triangle, shape (T,).
    """
    least, most = _bounds(corners, part, _count(part))
    return ((least <= high) & (most >= low)).all(axis=1)


def large_parts(corners: Floats, part: Ints, size: float) -> NDArray[np.bool_]:
    """Return which parts (N,) of triangles (T, 3, 3) are larger than a size [m]; `part` as in `near_parts`."""
    least, most = _bounds(corners, part, _count(part))
    return (most - least).max(axis=1) > size


def _count(part: Ints) -> int:
    return int(part.max(initial=-1)) + 1


def _bounds(corners: Floats, part: Ints, count: int) -> tuple[Floats, Floats]:
    """Return the least and the greatest coordinates of each of `count` parts, shape (N, K)."""
    least, most = np.full((count, corners.shape[-1]), np.inf), np.full((count, corners.shape[-1]), -np.inf)
    np.minimum.at(least, part, corners.min(axis=1))
    np.maximum.at(most, part, corners.max(axis=1))
    return least, most


def _around(
    points: Floats, faces: Ints, part: Ints, figure: FigureBox, camera: Camera, in_the_way: NDArray[np.bool_]
) -> tuple[Floats, Ints]:
    """Return what is shown of a collider with points (P, 3) and triangles (T, 3), likewise."""
    middle, reach = (figure.low + figure.high) / 2, REACH * figure.size
    low, high = middle - reach, middle + reach
    corners = points[faces]
    near = near_parts(corners, part, low, high)[part]
    hides, large = in_the_way[part] & near, large_parts(corners, part, reach)[part] & near
    forward = camera.axes()[2]
    offset = float(forward @ camera.position) + figure.depth(camera)
    behind, rows = cut_by_plane(corners[hides], forward, offset)
    still_large = large[hides][rows]
    cut = [
        behind[~still_large],
        cut_to_box(np.concatenate([behind[still_large], corners[large & ~hides]]), low, high),
    ]
    whole = near & ~hides & ~large
    long = edge_lengths(corners).max(axis=1) > EDGE * figure.size
    soup = split(np.concatenate([*cut, corners[whole & long]]), EDGE * figure.size)
    more = len(points) + np.arange(3 * len(soup)).reshape(-1, 3)
    return np.concatenate([points, soup.reshape(-1, 3)]), np.concatenate([faces[whole & ~long], more])


def _covers(corners: Floats, part: Ints, figure: FigureBox, camera: Camera) -> NDArray[np.bool_]:
    """Return which cells of the rectangle around a figure each part of triangles (T, 3, 3) covers before a camera.

    What is no nearer than the figure covers none, and of what is nearer the rectangle around it counts.

    Returns:
        shape (N, CELLS, CELLS).
    """
    count, forward = _count(part), camera.axes()[2]
    begin, nearest = float(forward @ camera.position), figure.depth(camera)
    before, rows = cut_by_plane(corners, -forward, -(begin + nearest))
    before, own = cut_by_plane(before, forward, begin + NEAREST)
    seen = camera.project(figure.corners, 1, 1)[0]
    scale, origin = CELLS / np.ptp(seen, axis=0), seen.min(axis=0)
    places = ((camera.project(before.reshape(-1, 3), 1, 1)[0] - origin) * scale).reshape(-1, 3, 2)
    least, most = _bounds(places, part[rows[own]], count)
    middles = np.arange(CELLS) + 0.5
    inside = (middles > least[..., None]) & (middles < most[..., None])  # (N, 2, CELLS)
    return inside[:, 0, :, None] & inside[:, 1, None]


def level(collider: Collider, size: float) -> float | None:
    """Return the height of a wide and level floor that stays [m]; None where a collider is none."""
    if len(collider.points) > 1 or len(collider.placements) > 1 or not collider.present.all():
        return None
    place = collider.placements[0]
    points = (collider.points[0] @ place[:3, :3].T + place[:3, 3])[np.unique(collider.faces)]
    across, along = np.ptp(points[:, 0]), np.ptp(points[:, 2])
    flat = np.ptp(points[:, 1]) < LEVEL and min(across, along) > WIDE * size
    return float(points[:, 1].mean()) if flat else None
