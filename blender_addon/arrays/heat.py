# SPDX-License-Identifier: GPL-3.0-or-later
"""Stretch of cloth, penetration depth, the worst frames and the colours of a heat map, with numpy alone."""

from __future__ import annotations

import numpy as np

COLORS = np.array([[0.1, 0.2, 0.6], [0.1, 0.7, 0.8], [0.3, 0.8, 0.2], [1.0, 0.9, 0.1], [0.9, 0.1, 0.1]])  # sRGB
UNCOVERED, BARE = -1.0, -2.0  # values of skin where no cloth is in the bind pose, and where none is near any more
GREY = np.array([0.35, 0.35, 0.35])  # where there is nothing to see


def colors_of(values: np.ndarray, largest: float) -> np.ndarray:
    """Return opaque sRGB colours, shape (V, 4): grey at zero and below, then blue to red at `largest` and beyond."""
    place = np.clip(values / largest, 0, 1) * (len(COLORS) - 1)
    ramp = np.stack([np.interp(place, np.arange(len(COLORS)), channel) for channel in COLORS.T], axis=1)
    shown = np.where((values > 0)[:, None], ramp, GREY)
    return np.concatenate([shown, np.ones((len(values), 1))], axis=1)


def elongations(rest: np.ndarray, points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the largest elongation of each vertex's triangles since rest, shape (V,).

    That of a triangle is the larger principal stretch less one: the larger singular value of the deformation
    gradient, from the plane of the triangle at rest to space.

    Args:
        rest, points: shape (V, 3), in the same units; triangles: shape (T, 3).
    """
    first, second = (rest[triangles[:, corner]] - rest[triangles[:, 0]] for corner in (1, 2))
    length = np.linalg.norm(first, axis=1)
    along = (first * second).sum(axis=1) / np.maximum(length, 1e-30)
    height = np.sqrt(np.maximum((second**2).sum(axis=1) - along**2, 0))
    flat = length * height > 1e-20  # others have no plane
    a, b = (points[triangles[:, corner]] - points[triangles[:, 0]] for corner in (1, 2))
    u = a[flat] / length[flat, None]
    v = (b[flat] - along[flat, None] * u) / height[flat, None]
    uu, vv, uv = ((p * q).sum(axis=1) for p, q in ((u, u), (v, v), (u, v)))
    largest = np.sqrt((uu + vv) / 2 + np.sqrt(((uu - vv) / 2) ** 2 + uv**2))
    found = np.zeros(len(rest))
    for corners in triangles[flat].T:
        np.maximum.at(found, corners, largest - 1)
    return found


def told_inside(deep: np.ndarray) -> str:
    """Return in words how much cloth lies inside a body, by how deep its vertices do [m], shape (V,)."""
    count = int((deep > 0).sum())
    if not count:
        return "Nothing is inside the body"
    share = f"{count / len(deep):.1%} of the vertices" if count > 1 else "One vertex"
    return f"{share} {'are' if count > 1 else 'is'} inside the body, {1000 * deep.max():.1f} mm at most"


def depths(
    points: np.ndarray, places: np.ndarray, nearest: np.ndarray, body: np.ndarray, triangles: np.ndarray
) -> np.ndarray:
    """Return how deep points lie inside a closed surface, negative outside, shape (N,).

    The side is told by normals between the corners' angle-weighted ones: beyond an edge or a corner, where several
    triangles are as near, that of one of them may point the wrong way [Baerentzen, Aanaes 2005].

    Args:
        points: shape (N, 3); places: the nearest point of the surface to each one, shape (N, 3).
        nearest: the triangle that it lies on, shape (N,).
        body: points of the surface, shape (B, 3); triangles: outward, shape (T, 3).
    """
    corners = triangles[nearest]
    shares = _barycentric(places, body[corners])
    normals = (shares[:, :, None] * corner_normals(body, triangles)[corners]).sum(axis=1)
    away = points - places
    return np.where((away * normals).sum(axis=1) < 0, 1, -1) * np.linalg.norm(away, axis=1)


def shown_depths(covered: np.ndarray, above: np.ndarray, beneath: np.ndarray) -> np.ndarray:
    """Return how far beneath the skin the cloth is where skin shows, and zero where cloth is above, shape (V,).

    It is `BARE` where covered skin has no cloth near, and `UNCOVERED` where none covers it in the bind pose.

    Args:
        covered: whether cloth is above each vertex in the bind pose.
        above, beneath: distance of the cloth above and beneath it, infinity where none is within reach.
    """
    near = np.where(np.isfinite(beneath), np.maximum(beneath, np.finfo(np.float32).tiny), BARE)
    return np.where(covered, np.where(np.isfinite(above), 0.0, near), UNCOVERED)


def _barycentric(places: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return the shares of a triangle's corners (N, 3, 3) in points of its plane (N, 3), shape (N, 3)."""
    opposite = np.stack(
        [np.cross(corners[:, (k + 1) % 3] - places, corners[:, (k + 2) % 3] - places) for k in range(3)], 1
    )
    whole = opposite.sum(axis=1, keepdims=True)
    return (opposite * whole).sum(axis=2) / np.maximum((whole**2).sum(axis=2), 1e-30)


def corner_normals(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return the normals of points, of their triangles' weighted by the angle at the point, shape (V, 3)."""
    corners = points[triangles]
    faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    faces /= np.maximum(np.linalg.norm(faces, axis=1, keepdims=True), 1e-30)
    normals = np.zeros_like(points)
    for k in range(3):
        u, v = (corners[:, (k + step) % 3] - corners[:, k] for step in (1, 2))
        angles = np.arctan2(np.linalg.norm(np.cross(u, v), axis=1), (u * v).sum(axis=1))
        np.add.at(normals, triangles[:, k], angles[:, None] * faces)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)


def worst_frames(values: np.ndarray, count: int, apart: int) -> list[int]:
    """Return the indices of the largest values above zero, largest first, no two nearer than `apart`."""
    chosen: list[int] = []
    for index in np.argsort(-values, kind="stable").tolist():
        if len(chosen) == count or values[index] <= 0:
            break
        if all(abs(index - other) >= apart for other in chosen):
            chosen.append(index)
    return chosen
