# SPDX-License-Identifier: Apache-2.0
"""A perspective camera, and cameras that follow a shot steadily."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from ...scene.assets import UP, Floats

FRAMING_MARGIN = 1.08  # factor on the distance that leaves room around the figure
PATH_SMOOTHING = 0.5  # [s] standard deviation of the path filter: slower than steps, faster than turns
STATIC_CAMERA_TRAVEL = 0.4  # share of its size that a figure may travel in front of a static camera


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera at `position` looking at `target` [m]; `fov` is the vertical field of view [degrees]."""

    position: Floats
    target: Floats
    up: Floats = field(default_factory=UP.copy)
    fov: float = 30.0

    def axes(self) -> Floats:
        """Return the unit vectors right, up and forward, shape (3, 3)."""
        forward = _unit(np.subtract(self.target, self.position))
        right = _unit(np.cross(forward, self.up))
        return np.stack([right, np.cross(right, forward), forward])

    def directions(self, x: Floats, y: Floats, width: int, height: int) -> Floats:
        """Return unit rays through pixel coordinates (...), float32, shape (..., 3); (0, 0) is top left."""
        half = np.tan(np.radians(self.fov) / 2)
        across, upward = (2 * x - width) / height * half, (1 - 2 * y / height) * half
        # float32 throughout, and a product of matrices, because a picture has a million of these.
        rays = np.stack([across, upward, np.ones_like(across)], axis=-1, dtype=np.float32, casting="same_kind")
        rays = rays @ self.axes().astype(np.float32)
        return rays / np.sqrt(np.einsum("...k,...k", rays, rays))[..., None]

    def project(self, points: Floats, width: int, height: int) -> tuple[Floats, Floats]:
        """Return pixel coordinates (N, 2) and depths along the view [m] (N,) of points in front of the camera."""
        right, up, depth = self.axes() @ (np.asarray(points) - self.position).T
        scale = height / (2 * np.tan(np.radians(self.fov) / 2) * depth)
        return np.stack([width / 2 + right * scale, height / 2 - up * scale], axis=1), depth


def _unit(vector: Floats) -> Floats:
    return vector / np.linalg.norm(vector)


def follow_cameras(
    frames: Iterable[Floats],
    fps: float,
    aspect: float,
    *,
    azimuth: float = 30.0,
    elevation: float = 8.0,
    fov: float = 28.0,
) -> list[Camera]:
    """Return one camera per frame; all have the same direction, and each shows all points of its frame.

    The target follows the smoothed path of the figure at a constant height, and the distance changes slowly, so that
    steps and flapping cloth do not shake the picture. If the figure does not travel, the camera is static.

    Args:
        frames: the points of each frame [m], each (N, 3); iterated once.
        fps: frames per second [1/s].
        aspect: ratio of the picture's width to its height.
        azimuth: direction of the camera, from +z towards +x [degrees].
        elevation: angle of the camera above the horizon [degrees].
        fov: vertical field of view [degrees].
    """
    turn, tilt = np.radians([azimuth, elevation])
    back = np.array([np.sin(turn) * np.cos(tilt), np.sin(tilt), np.cos(turn) * np.cos(tilt)])
    view = Camera(back, np.zeros(3), fov=fov)
    right = view.axes()[0]
    level = np.stack([right, UP, np.cross(UP, right)])
    boxes = np.array([[seen.min(axis=0), seen.max(axis=0)] for seen in (points @ level.T for points in frames)])
    centres, deviation = _centres(boxes), PATH_SMOOTHING * fps
    if _stays(boxes):
        targets = np.broadcast_to((centres.min(axis=0) + centres.max(axis=0)) / 2, centres.shape)
        distances = np.full(len(boxes), _distances(boxes, targets, view, level, aspect).max())
    else:
        reach = _reach(deviation)
        # The path is extrapolated past its ends, so that the filter does not lag there.
        path = np.pad(centres, ((reach, reach), (0, 0)), mode="reflect", reflect_type="odd")
        targets = np.stack([_smoothed(column, deviation) for column in path.T], axis=1)
        distances = _eased(_distances(boxes, targets, view, level, aspect), deviation)
    return [
        Camera(target + FRAMING_MARGIN * away * back, target, fov=fov)
        for target, away in zip(targets @ level, distances)
    ]


def _centres(boxes: Floats) -> Floats:
    """Return the centres (F, 3) of boxes (F, 2, 3), all at one height for the entire shot; y is up."""
    centres = boxes.mean(axis=1)
    centres[:, 1] = (boxes[:, 0, 1].min() + boxes[:, 1, 1].max()) / 2
    return centres


def _stays(boxes: Floats) -> bool:
    """Return whether a figure travels less than a small part of its size."""
    size = np.median(boxes[:, 1] - boxes[:, 0], axis=0).max()
    return bool(np.ptp(boxes.mean(axis=1)[:, ::2], axis=0).max() < STATIC_CAMERA_TRAVEL * size)


def _distances(boxes: Floats, targets: Floats, view: Camera, level: Floats, aspect: float) -> Floats:
    """Return the least distance from the target of each frame at which its entire box is visible [m], shape (F,)."""
    pick = np.indices((2, 2, 2)).reshape(3, 8)
    corners = np.stack([boxes[:, pick[k], k] for k in range(3)], axis=-1) - targets[:, None]
    right, up, forward = np.moveaxis(corners @ level @ view.axes().T, -1, 0)
    half = np.tan(np.radians(view.fov) / 2)
    return (np.maximum(np.abs(right) / aspect, np.abs(up)) / half - forward).max(axis=1)


def _eased(needed: Floats, deviation: float) -> Floats:
    """Return a smooth upper bound of `needed` (F,): a sliding maximum, then a filter of the same width."""
    reach = _reach(deviation)
    padded = np.pad(needed, 2 * reach, mode="edge")
    return _smoothed(np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1).max(axis=1), deviation)


def _reach(deviation: float) -> int:
    return int(np.ceil(3 * deviation))


def _smoothed(padded: Floats, deviation: float) -> Floats:
    """Return a Gaussian filter of a curve (F + 2 reach), shape (F,)."""
    reach = _reach(deviation)
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / deviation) ** 2)
    return np.convolve(padded, kernel / kernel.sum(), mode="valid")
