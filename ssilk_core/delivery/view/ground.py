# SPDX-License-Identifier: Apache-2.0
"""Render the stage: a floor with a faint grid that fades into a plain backdrop, and the shadows on it."""

from __future__ import annotations

import numpy as np

from ...scene.assets import Floats
from .camera import Camera
from .light import LAMP_RAYS, Lighting, LitGeometry, sky_directions, sky_radiance
from .surface import linear

BACKDROP, HAZE, FLOOR = linear([0.70, 0.735, 0.775]), linear([0.90, 0.91, 0.92]), linear([0.855, 0.86, 0.868])
GRID_LINE_BRIGHTNESS = 0.86  # brightness of grid lines against the floor
GRID_SPACING, GRID_LINE_WIDTH = 0.5, 0.008  # of the grid [m]
FADE_START, FADE_END = (
    0.4,
    3.3,
)  # [view distances] from the target between which the floor fades
KEY_SHADE = 0.42  # darkness of the key lamp's shadow
SKY_SHADE = 0.75  # darkness where the floor sees no sky
PENUMBRA = 0.15  # how far the key lamp's shadow may spread past its centre [m]
SKY_SHADE_RADIUS = 0.7  # how far around the figure the sky's shade is computed [m]
SKY_SHADE_CELL = 0.06  # its grid [m]
FLOOR_RAYS = 160  # directions over the sphere, of which the floor sees half


def render_stage(lit: LitGeometry, rig: Lighting, camera: Camera, directions: Floats, height: float) -> Floats:
    """Return the linear colours of the stage, shape (H, W, 3).

    Args:
        lit: the geometry on the stage.
        rig: the lamps.
        camera: the camera.
        directions: unit rays through the pixels, shape (H, W, 3).
        height: height of the floor [m].
    """
    distance = floor_distance(camera, directions, height)
    run = np.where(np.isfinite(distance), distance, 0)
    x, z = (np.float32(camera.position[k]) + run * directions[..., k] for k in (0, 2))
    away = np.hypot(x - np.float32(camera.target[0]), z - np.float32(camera.target[2]))
    reach = np.float32(np.linalg.norm(camera.target - camera.position))
    haze = np.where(np.isfinite(distance), np.clip((away / reach - FADE_START) / (FADE_END - FADE_START), 0, 1), 1)
    haze = haze * (1.5 - 0.5 * haze)
    lines = 1 - (1 - GRID_LINE_BRIGHTNESS) * np.maximum(_line_cover(x), _line_cover(z))
    shade = lines * _sky_shade(lit, x, z, height) * _key_shade(lit, rig, x, z, height)
    upward = np.clip(directions[..., 1] * 3.0 + 0.05, 0, 1)
    sky = upward * upward * (3 - 2 * upward)
    return np.stack([shade * (1 - haze), haze * (1 - sky), haze * sky], axis=-1) @ np.stack([FLOOR, HAZE, BACKDROP])


def floor_distance(camera: Camera, directions: Floats, height: float) -> Floats:
    """Return the distance along unit rays (..., 3) to the floor [m], infinite without a hit, shape (...)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.float32(height - camera.position[1]) / directions[..., 1]
    return np.where(distance > 0, distance, np.float32(np.inf))


def _line_cover(coordinate: Floats) -> Floats:
    """Return the share of each pixel that grid lines cover, by a box filter of the pixel's width on the floor."""
    down, across = (np.abs(np.gradient(coordinate, axis=axis)) for axis in (0, 1))
    width = np.maximum(down + across, 1e-6)

    def covered_until(position: Floats) -> Floats:
        cell = np.floor(position / GRID_SPACING)
        return cell * GRID_LINE_WIDTH + np.minimum(position - cell * GRID_SPACING, GRID_LINE_WIDTH)

    start = coordinate + GRID_LINE_WIDTH / 2 - width / 2
    return np.clip((covered_until(start + width) - covered_until(start)) / width, 0, 1)


def _key_shade(lit: LitGeometry, rig: Lighting, x: Floats, z: Floats, height: float) -> Floats:
    """Return the floor's brightness (H, W) under the key lamp, with a soft edge."""
    points = lit.geometry.points
    cast = points[:, ::2] - (points[:, 1:2] - height) * (rig.key[::2] / rig.key[1])
    reach = np.concatenate([points[:, ::2], cast])
    low, high = reach.min(axis=0) - PENUMBRA, reach.max(axis=0) + PENUMBRA
    inside = (x > low[0]) & (x < high[0]) & (z > low[1]) & (z < high[1])
    floor = np.stack([x[inside], np.full(np.count_nonzero(inside), height, np.float32), z[inside]], axis=1)
    blocked = _blocked_lamps(lit, rig.lamp[:4], floor)
    edge = (blocked > 0) & (blocked < 4)  # only the shadow's edge needs the other points of the lamp
    blocked[~edge] *= LAMP_RAYS / 4
    blocked[edge] += _blocked_lamps(lit, rig.lamp[4:], floor[edge])
    shade = np.ones(x.shape, dtype=np.float32)
    shade[inside] = 1 - KEY_SHADE / LAMP_RAYS * blocked
    return shade


def _blocked_lamps(lit: LitGeometry, lamps: Floats, points: Floats) -> Floats:
    """Return how many points of the lamp (L, 3) are hidden from points (N, 3), shape (N,)."""
    return np.sum([lit.tracer.blocked(points, lamp) for lamp in lamps], axis=0, dtype=np.float32)


def _sky_shade(lit: LitGeometry, x: Floats, z: Floats, height: float) -> Floats:
    """Return the floor's brightness (H, W) under the sky, computed on a grid around the figure and interpolated."""
    points = lit.geometry.points[:, ::2]
    low = np.floor((points.min(axis=0) - SKY_SHADE_RADIUS) / SKY_SHADE_CELL) * SKY_SHADE_CELL
    count = np.ceil((points.max(axis=0) + SKY_SHADE_RADIUS - low) / SKY_SHADE_CELL).astype(int) + 1
    across, along = (low[k] + SKY_SHADE_CELL * np.arange(count[k]) for k in (0, 1))
    grid = np.stack(np.meshgrid(across, [height], along, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.float32)
    shade = _softened(_sky_share(lit, grid).reshape(count))
    fade = [np.clip(np.minimum(c - c[0], c[-1] - c) / SKY_SHADE_RADIUS, 0, 1) for c in (across, along)]
    return _bilinear(
        1 - SKY_SHADE * (1 - shade) * np.outer(*fade), (x - low[0]) / SKY_SHADE_CELL, (z - low[1]) / SKY_SHADE_CELL
    )


def _sky_share(lit: LitGeometry, points: Floats) -> Floats:
    """Return the share of the sky's light that reaches level points (N, 3), shape (N,)."""
    directions = sky_directions(FLOOR_RAYS)
    directions = directions[directions[:, 1] > 0]
    weight = directions[:, 1] * sky_radiance(directions).mean(axis=1)
    origins = np.repeat(points, len(directions), axis=0)
    blocked = lit.tracer.blocked(origins, np.tile(directions, (len(points), 1)))
    return 1 - blocked.reshape(len(points), -1) @ (weight / weight.sum())


def _softened(values: Floats) -> Floats:
    """Blur a grid with a binomial filter, to hide artefacts of the discrete sky directions."""
    for axis in (0, 1):
        padded = np.pad(values, [(2, 2) if k == axis else (0, 0) for k in (0, 1)], mode="edge")
        shifted = [np.take(padded, np.arange(k, k + values.shape[axis]), axis=axis) for k in range(5)]
        values = sum(weight / 16 * part for weight, part in zip((1, 4, 6, 4, 1), shifted))  # type: ignore[assignment]
    return values


def _bilinear(values: Floats, u: Floats, v: Floats) -> Floats:
    """Interpolate a grid (M, N) at fractional places (H, W); 1 outside of it."""
    inside = (u >= 0) & (v >= 0) & (u < values.shape[0] - 1) & (v < values.shape[1] - 1)
    result = np.ones(u.shape, dtype=np.float32)
    u, v = u[inside], v[inside]
    i, j = u.astype(int), v.astype(int)
    a, b = u - i, v - j
    near = values[i, j] * (1 - b) + values[i, j + 1] * b
    far = values[i + 1, j] * (1 - b) + values[i + 1, j + 1] * b
    result[inside] = near * (1 - a) + far * a
    return result
