# SPDX-License-Identifier: Apache-2.0
"""Draw surfaces on a lit stage: ray casting with Embree, shading in numpy; no GPU, no window, no system library."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...errors import fail
from ...scene.assets import Floats, Ints
from .camera import Camera
from .ground import floor_distance, render_stage
from .light import Lighting, LitGeometry
from .shade import shade
from .surface import Geometry, Surface

Image = NDArray[np.uint8]
ROTATED_GRID = ((0.125, 0.625), (0.375, 0.125), (0.625, 0.875), (0.875, 0.375))  # (y, x) within a pixel
CONTRAST = 0.04  # between neighbours, on a scale of brightness as the eye sees it, that makes an edge


def render(
    surfaces: Sequence[Surface], camera: Camera, width: int, height: int, *, samples: int = 4, ground: float = 0.0
) -> Image:
    """Return a picture of surfaces on a floor, uint8 sRGB, shape (height, width, 3).

    Args:
        surfaces: what to draw; together they need at least one face.
        camera: where from.
        width, height: size [pixels].
        samples: rays for each pixel on an edge, 1 or 4 (smooth).
        ground: height of the floor [m].

    Raises:
        SsilkError: there is nothing to draw, or `samples` is neither 1 nor 4.
    """
    if samples not in (1, 4):
        fail("rendering", f"{samples} samples", "1 and 4 are allowed")
    geometry = Geometry.of(surfaces)
    if not len(geometry.faces):
        fail("rendering", "the surfaces have no faces", "at least one triangle is needed")
    lit, rig = LitGeometry.of(geometry), Lighting.for_camera(camera)
    view = View(lit, rig, camera, width, height, ground)
    picture = render_stage(lit, rig, camera, view.rays(*np.mgrid[:height, :width] + 0.5), ground)
    _draw(picture, view, samples)
    return _encoded(picture)


@dataclass(frozen=True, eq=False)
class View:
    """A lit geometry as one camera sees it."""

    lit: LitGeometry
    rig: Lighting
    camera: Camera
    width: int
    height: int
    ground: float

    def rays(self, y: Floats, x: Floats) -> Floats:
        """Return unit rays through pixel coordinates (...), shape (..., 3)."""
        return self.camera.directions(x, y, self.width, self.height)

    def colours(self, y: Floats, x: Floats, lamps: Ints) -> Floats:
        """Return linear colour and cover (0 or 1) of the geometry at pixel coordinates (...), shape (..., 4)."""
        directions = self.rays(y, x).reshape(-1, 3)
        hits = self.lit.tracer.first_hits(np.asarray(self.camera.position, dtype=np.float32), directions)
        hits = hits.where(hits.distances < floor_distance(self.camera, directions[hits.rays], self.ground))
        colours = np.zeros((len(directions), 4), dtype=np.float32)
        colours[hits.rays, :3] = shade(self.lit, hits, directions[hits.rays], self.rig, lamps.reshape(-1)[hits.rays])
        colours[hits.rays, 3] = 1
        return colours.reshape(*y.shape, 4)


def _draw(picture: Floats, view: View, samples: int) -> None:
    """Draw the geometry over the stage in `picture`, in place; pixels on an edge take `samples` rays."""
    left, top, right, bottom = _screen_box(view)
    row, column = np.mgrid[top:bottom, left:right]
    layer = view.colours(row + 0.5, column + 0.5, row % 4 * 4 + column % 4)
    if samples > 1:
        edges = _edges(layer)
        row, column = row[edges], column[edges]
        lamps = row % 2 * 2 + column % 2
        parts = [view.colours(row + y, column + x, 4 * k + lamps) for k, (y, x) in enumerate(ROTATED_GRID)]
        layer[edges] = np.mean(parts, axis=0)
    region = picture[top:bottom, left:right]
    region *= 1 - layer[..., 3:]
    region += layer[..., :3]


def _edges(layer: Floats) -> np.ndarray:
    """Return which pixels (H, W) differ from a neighbour in cover or, as the eye sees it, in colour."""
    seen = np.sqrt(layer)
    edges = np.zeros(layer.shape[:2], dtype=bool)
    for first, second in ((np.s_[1:], np.s_[:-1]), (np.s_[:, 1:], np.s_[:, :-1])):
        steps = np.abs(seen[first] - seen[second]).max(axis=-1) > CONTRAST
        edges[first] |= steps
        edges[second] |= steps
    return edges


def _screen_box(view: View) -> tuple[int, int, int, int]:
    """Return left, top, right, bottom of the pixels that the geometry may cover."""
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels, depth = view.camera.project(view.lit.geometry.points, view.width, view.height)
    size = np.array([view.width, view.height])
    if depth.min() < 1e-2:
        return 0, 0, view.width, view.height
    left, top = np.clip(np.floor(pixels.min(axis=0)) - 1, 0, size).astype(int)
    right, bottom = np.clip(np.ceil(pixels.max(axis=0)) + 1, 0, size).astype(int)
    return left, top, max(left, right), max(top, bottom)


def _encoded(picture: Floats) -> Image:
    """Return linear light as sRGB bytes, with highlights rolled off above 0.8."""
    rolled = np.where(picture > 0.8, 1 - 0.2 * np.exp(-(picture - 0.8) / 0.2), picture)
    return (np.clip(rolled, 0, 1) ** (1 / 2.2) * 255 + 0.5).astype(np.uint8)
