# SPDX-License-Identifier: Apache-2.0
"""Floors and props that the cloth of a shot met, as a page plays them: around the way of the figure."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ...events import Message, Reporter
from ...scene.assets import Floats, Ints
from ..view.cut import cut_to_box
from ..view.props import LEVEL, REACH, FigureBox, ShotProps, level, near_parts

MOST_VALUES = 6_000_000  # coordinates of the props of a shot
FEW = 500  # triangles of a prop that are large, such as those of a box: each is shaded flat


@dataclass(frozen=True, eq=False)
class PlayedProp:
    """A collider in a page.

    Attributes:
        points: in the world [m], shape (F, P, 3), or (1, P, 3) where it stays.
        faces: triangles, shape (T, 3).
    """

    name: str
    points: Floats
    faces: Ints


def played_props(
    props: ShotProps,
    frames: Sequence[int],
    figures: Sequence[FigureBox],
    ground: float,
    aside: float,
    report: Reporter,
) -> Iterator[PlayedProp]:
    """Yield what a page shows of the colliders of a shot, but for its ground; tell what is too much for it.

    Args:
        figures: boxes around the figure in these frames, which stand `aside` [m] of where the shot has them.
    """
    size, left = float(np.median([box.size for box in figures])), MOST_VALUES
    low = np.min([box.low for box in figures], axis=0) - [aside, 0, 0] - REACH * size
    high = np.max([box.high for box in figures], axis=0) - [aside, 0, 0] + REACH * size
    for number, collider in enumerate(props.world.colliders):
        height = level(collider, size)
        if height is not None and abs(height - ground) < LEVEL:
            continue
        stays = len(collider.points) == len(collider.placements) == len(collider.present) == 1
        found = [props.posed(number, frame) for frame in (frames[:1] if stays else frames)]
        faces = _shown(found, collider.faces, props.parts[number], low, high)
        if stays and found[0] is not None:  # what reaches far beyond the figure is cut
            points, faces = _cut(found[0], faces, low, high)
            found = [points]
        if not len(faces):
            continue
        used, faces = (faces, np.arange(faces.size)) if len(faces) <= FEW else np.unique(faces, return_inverse=True)
        placed = np.stack([_gathered(each, used, (low + high) / 2) for each in found])
        if placed.size > left:
            text = f"{collider.path}: it is too much for a page: {placed.size / 1e6:.1f} million coordinates"
            report(Message(f"{text}; the page does not show it", "warning"))
            continue
        left -= placed.size
        yield PlayedProp(collider.name, placed + [aside, 0, 0], faces.reshape(-1, 3))


def _shown(found: Sequence[Floats | None], faces: Ints, part: Ints, low: Floats, high: Floats) -> Ints:
    """Return the triangles of the parts that reach into a box in one of the frames."""
    near = np.zeros(part.max(initial=-1) + 1, dtype=bool)
    for points in found:
        if points is not None and not near.all():
            near |= near_parts(points[faces], part, low, high)
    return faces[near[part]]


def _cut(points: Floats, faces: Ints, low: Floats, high: Floats) -> tuple[Floats, Ints]:
    """Return points and triangles of what is in a box."""
    corners = points[faces]
    inside = ((corners >= low) & (corners <= high)).all(axis=(1, 2))
    soup = cut_to_box(corners[~inside], low, high)
    more = len(points) + np.arange(3 * len(soup)).reshape(-1, 3)
    return np.concatenate([points, soup.reshape(-1, 3)]), np.concatenate([faces[inside], more])


def _gathered(points: Floats | None, used: Ints, middle: Floats) -> Floats:
    """Return some points of a frame; all in one place, where nothing of it is seen, while it is not there."""
    return np.tile(middle, (used.size, 1)) if points is None else points[used.reshape(-1)]
