# SPDX-License-Identifier: Apache-2.0
"""The camera against projective closed forms, and how it follows a figure."""

from __future__ import annotations

import numpy as np
import pytest

from ssilk_core.delivery.view.camera import Camera, follow_cameras

WIDTH, HEIGHT, FPS = 200, 300, 30.0
RNG = np.random.default_rng(5)
FIGURE = RNG.uniform([-0.4, 0.0, -0.3], [0.4, 1.8, 0.3], size=(60, 3))


def walk(frames: int, shake: float = 0.0) -> list[np.ndarray]:
    """A figure that walks along x and z, turns round, and may shake from frame to frame [m]."""
    time = np.arange(frames) / FPS
    path = np.stack([1.4 * time, 0 * time, 2.0 * np.sin(time)], axis=1)
    return list(path[:, None] + FIGURE + shake * RNG.standard_normal((frames, 1, 3)))


def follow(frames: list[np.ndarray]) -> list[Camera]:
    return follow_cameras(frames, FPS, WIDTH / HEIGHT)


def test_projection_is_the_pinhole_formula():
    camera = Camera(np.array([0.0, 0.0, 5.0]), np.zeros(3), fov=40.0)
    pixels, depth = camera.project(np.array([[0.0, 0.0, 0.0], [0.5, 1.0, 1.0]]), WIDTH, HEIGHT)
    focal = HEIGHT / 2 / np.tan(np.radians(20.0))
    np.testing.assert_allclose(depth, [5, 4])
    np.testing.assert_allclose(pixels[0], [WIDTH / 2, HEIGHT / 2])
    np.testing.assert_allclose(pixels[1], [WIDTH / 2 + focal * 0.5 / 4, HEIGHT / 2 - focal * 1.0 / 4])


def test_rays_pass_through_what_is_projected():
    camera = Camera(np.array([3.0, 2.0, 5.0]), np.array([0.2, 1.0, -0.3]))
    pixels, _ = camera.project(FIGURE, WIDTH, HEIGHT)
    rays = camera.directions(*pixels.T, WIDTH, HEIGHT)
    expected = FIGURE - camera.position
    np.testing.assert_allclose(rays, expected / np.linalg.norm(expected, axis=1, keepdims=True), atol=1e-6)


@pytest.mark.parametrize(
    "frames", [walk(1), walk(2), walk(150), walk(60, shake=0.1)], ids=["1", "2", "150", "shaken"]
)
def test_every_point_of_every_frame_is_in_view(frames):
    for points, camera in zip(frames, follow(frames), strict=True):
        pixels, depth = camera.project(points, WIDTH, HEIGHT)
        assert depth.min() > 0
        assert (pixels > 0).all() and (pixels < (WIDTH, HEIGHT)).all()


def test_the_figure_fills_the_picture():
    frames = walk(150)
    for points, camera in zip(frames, follow(frames), strict=True):
        pixels, _ = camera.project(points, WIDTH, HEIGHT)
        assert (np.ptp(pixels, axis=0) / (WIDTH, HEIGHT)).max() > 0.6


def test_the_camera_does_not_shake_with_the_figure():
    frames = walk(150, shake=0.05)
    roots = np.array([points.mean(axis=0) for points in frames])
    for part in ("position", "target"):
        path = np.array([getattr(camera, part) for camera in follow(frames)])
        assert np.abs(np.diff(path, 2, axis=0)).max() < 0.05 * np.abs(np.diff(roots, 2, axis=0)).max()


def test_the_camera_stays_with_a_figure_that_stays():
    cameras = follow([FIGURE + 0.1 * np.sin(k / 5) for k in range(40)])
    assert len({(*camera.position, *camera.target) for camera in cameras}) == 1


def test_azimuth_turns_from_z_towards_x():
    camera = follow_cameras([FIGURE], FPS, 1.0, azimuth=90.0, elevation=0.0)[0]
    away = camera.position - camera.target
    np.testing.assert_allclose(away / np.linalg.norm(away), [1, 0, 0], atol=1e-12)
