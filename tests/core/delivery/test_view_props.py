# SPDX-License-Identifier: Apache-2.0
"""Floors and props in pictures: what is shown of them, where, and what is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from ssilk_core.delivery.view.camera import Camera
from ssilk_core.delivery.view.props import EDGE, REACH, ShotProps, cut_out
from ssilk_core.delivery.view.shots import Look, sheet_of_shots
from ssilk_core.scene.assets import Collider, ShotWorld
from ssilk_core.scene.kinematics import rigid

from .test_view_shots import ToyShot

FIGURE = np.array([[-0.5, 0.0, -0.5], [0.5, 2.0, 0.5]])
CAMERA = Camera(np.array([0.0, 1.0, 8.0]), np.array([0.0, 1.0, 0.0]))
HERE = np.ones(1, dtype=bool)


def quad(corners) -> Collider:
    return Collider("set.usda:/Set/Quad", np.array([[0, 1, 2], [0, 2, 3]]), np.array(corners, float)[None],
                    np.eye(4)[None], HERE)  # fmt: skip


def floor(height: float = 0.0, size: float = 1000.0) -> Collider:
    return quad([(-size, height, -size), (-size, height, size), (size, height, size), (size, height, -size)])


def wall(z: float) -> Collider:
    return quad([(-50, -1, z), (50, -1, z), (50, 9, z), (-50, 9, z)])


def shown(*colliders: Collider, frame: int = 0, ground: float = -1.0, camera: Camera = CAMERA):
    props = ShotProps(ShotWorld(10.0, colliders), lambda frame: frame / 10)
    return props.surfaces(frame, FIGURE, camera, ground)


def area(points: np.ndarray, faces: np.ndarray) -> float:
    return float(trimesh.Trimesh(points, faces, process=False).area)


def test_a_vast_floor_is_shown_around_the_figure_in_small_triangles():
    (surface,) = shown(floor(-0.2))
    corners = surface.points[surface.faces]
    edges = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    size = 2.0
    assert edges.max() <= EDGE * size and len(corners) < 20_000
    across = corners[..., [0, 2]].reshape(-1, 2)
    assert (np.abs(across) <= REACH * size + EDGE * size).all()
    behind = corners[corners[..., 2].max(axis=1) <= 0.3]  # nothing of this side is before the figure
    wide = 2 * REACH * size * (REACH * size + 0.3)
    assert area(behind.reshape(-1, 3), np.arange(3 * len(behind)).reshape(-1, 3)) == pytest.approx(wide, rel=0.1)


def test_small_triangles_keep_their_shared_vertices_and_area():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    points, faces = cut_out(np.asarray(ball.vertices), ball.faces, np.zeros(3), 1.0, 0.2)
    assert len(points) == len(ball.vertices) and np.array_equal(faces, ball.faces)
    coarse = trimesh.creation.box((1, 1, 1))
    points, faces = cut_out(np.asarray(coarse.vertices), coarse.faces, np.zeros(3), 1.0, 0.3)
    assert area(points, faces) == pytest.approx(6) and len(faces) > 12


def test_what_stands_between_camera_and_figure_is_left_out():
    assert shown(wall(3.0)) == []
    (behind,) = shown(wall(-3.0))
    assert np.allclose(behind.points[behind.faces][..., 2], -3)
    turned = Camera(np.array([0.0, 1.0, -8.0]), CAMERA.target)
    assert shown(wall(-3.0), camera=turned) == [] and len(shown(wall(3.0), camera=turned)) == 1


def test_props_are_where_their_world_has_them_and_when():
    places = rigid(np.eye(3)[None].repeat(3, 0), np.array([[0, 0, 0], [0, 0, -1.0], [0, 0, -2]]))
    moving = replace(wall(-1.0), placements=places, present=np.array([True, True, False]))
    for frame, z in ((0, -1.0), (1, -2.0)):
        (surface,) = shown(moving, frame=frame)
        assert np.allclose(surface.points[surface.faces][..., 2], z)
    assert shown(moving, frame=2) == []


def test_a_level_floor_is_the_ground_of_the_picture():
    props = ShotProps(ShotWorld(10.0, (floor(-0.3), floor(7.0), floor(0.0, 0.5), wall(-2.0))), lambda frame: 0.0)
    assert props.ground(0.1, 2.0) == pytest.approx(-0.3) and props.ground(7.1, 2.0) == pytest.approx(7.0)
    drawn = [surface.points[surface.faces][..., 1].max() for surface in props.surfaces(0, FIGURE, CAMERA, -0.3)]
    assert len(drawn) == 2 and min(drawn) == 0  # the small one and the wall
    assert ShotProps(ShotWorld(10.0, (wall(-2.0),)), float).ground(0.0, 2.0) is None


def test_a_ceiling_is_no_ground_and_feet_sink_into_a_floor():
    ceiling = ShotProps(ShotWorld(10.0, (floor(2.5),)), float)
    assert ceiling.ground(0.0, 2.0) is None and ceiling.ground(2.3, 2.0) == pytest.approx(2.5)
    assert ShotProps(ShotWorld(10.0, (floor(2.5), floor(-9.0))), float).ground(0.0, 2.0) == pytest.approx(-9.0)


def test_sheets_show_props_beside_the_figure(tmp_path):
    shot = ToyShot()
    points = np.concatenate(shot.points(shot.frame_times[0]))
    low, high = points.min(axis=0), points.max(axis=0)
    box = trimesh.creation.box((high - low).max() * np.ones(3))
    box.apply_translation((low + high) / 2 - [1.2 * (high - low).max(), 0, 1.2 * (high - low).max()])
    collider = Collider("/Box", box.faces, np.asarray(box.vertices)[None], np.eye(4)[None], HERE)
    props = ShotProps(ShotWorld(10.0, (collider,)), lambda frame: 0.0)
    look, sheets = Look(width=64, height=64, samples=1), []
    for number, met in enumerate(([], [None], [props])):
        path = tmp_path / f"{number}.png"
        sheet_of_shots(path, [shot], columns=1, look=look, props=met)
        sheets.append(path.read_bytes())
    assert sheets[0] == sheets[1] != sheets[2]
