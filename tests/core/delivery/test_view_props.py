# SPDX-License-Identifier: Apache-2.0
"""Floors and props in pictures: what is shown of them, where, and what is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from ssilk_core.delivery.view.camera import Camera
from ssilk_core.delivery.view.cut import cut_by_plane, cut_to_box, split
from ssilk_core.delivery.view.props import EDGE, REACH, FigureBox, ShotProps
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
    props, figure = ShotProps(ShotWorld(10.0, colliders), lambda frame: frame / 10), FigureBox.of(FIGURE)
    return props.surfaces(frame, figure, camera, ground, props.in_the_way([figure], [camera], [frame]))


def area(points: np.ndarray, faces: np.ndarray) -> float:
    return float(trimesh.Trimesh(points, faces, process=False).area)


def test_a_vast_floor_is_shown_around_the_figure_in_small_triangles():
    (surface,) = shown(floor(-0.2))
    corners = surface.points[surface.faces]
    edges = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    size = 2.0
    assert edges.max() <= EDGE * size and len(corners) < 20_000
    across = corners[..., [0, 2]].reshape(-1, 2)
    assert np.abs(across).max() == pytest.approx(REACH * size)
    assert area(surface.points, surface.faces) == pytest.approx((2 * REACH * size) ** 2)


def test_a_plane_cuts_triangles_straight_and_keeps_their_sides():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    corners, rows = cut_by_plane(ball.triangles, np.array([0.0, 0.6, 0.8]), 0.1)
    height = corners @ [0.0, 0.6, 0.8]
    assert height.min() == pytest.approx(0.1) and len(np.unique(rows)) < len(ball.faces)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert (np.einsum("nk,nk->n", normals, ball.face_normals[rows]) >= 0).all()
    other, _ = cut_by_plane(ball.triangles, np.array([0.0, -0.6, -0.8]), -0.1)
    assert soup_area(corners) + soup_area(other) == pytest.approx(ball.area)
    assert soup_area(corners) == pytest.approx(2 * np.pi * 0.5 * 0.4, rel=0.01)  # of a spherical cap


def test_what_is_in_a_box_is_cut_out_and_split_without_loss():
    box = trimesh.creation.box((1, 1, 1))
    corners = cut_to_box(box.triangles, np.array([-9.0, -0.25, -9]), np.array([9.0, 0.25, 9]))
    assert soup_area(corners) == pytest.approx(2)
    small = split(corners, 0.3)
    assert soup_area(small) == pytest.approx(2) and len(small) > len(corners)
    assert np.linalg.norm(small - np.roll(small, 1, axis=1), axis=2).max() <= 0.3


def soup_area(corners: np.ndarray) -> float:
    return area(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))


def boxed(size: float, at: tuple[float, float, float]) -> Collider:
    box = trimesh.creation.box(size * np.ones(3))
    points = np.asarray(box.vertices) + at
    return Collider("set.usda:/Set/Box", box.faces, points[None], np.eye(4)[None], HERE)


@pytest.mark.parametrize(
    "at", [(1.2, 0.3, 0.4), (0.0, 0.3, 0.5), (0.3, 0.3, 1.4)], ids=["beside", "across", "before"]
)
def test_a_box_near_the_camera_is_whole(at):
    """Beside the figure, through the plane before it, and before its feet: no part of it is torn off."""
    (surface,) = shown(boxed(0.6, at))
    assert area(surface.points, surface.faces) == pytest.approx(6 * 0.6**2)


def test_a_room_and_a_fence_that_hide_the_figure_are_cut_straight_before_it_in_all_frames():
    room = boxed(2.9, (0, 1.0, 0.4))  # its near wall is 1.35 m before the figure
    (surface,) = shown(room)
    used = surface.points[surface.faces]
    assert used[..., 2].max() == pytest.approx(0.5) and used[..., 2].min() == pytest.approx(-1.05)
    planks = [quad([(x, 0, 2), (x + 0.19, 0, 2), (x + 0.19, 2, 2), (x, 2, 2)]) for x in np.arange(-0.4, 0.4, 0.2)]
    assert len(shown(planks[0])) == 1 and shown(*planks) == []
    figure, away = FigureBox.of(FIGURE), FigureBox.of(FIGURE + [5.0, 0, 0])
    side = Camera(CAMERA.position + [5.0, 0, 0], CAMERA.target + [5.0, 0, 0])
    props = ShotProps(ShotWorld(10.0, tuple(planks)), lambda frame: frame / 10)
    way = props.in_the_way([figure, away], [CAMERA, side], [0, 1])
    middle = Camera(np.array([1.0, 1.0, 8.0]), np.array([1.0, 1.0, 0.0]))
    beside = FigureBox.of(FIGURE + [1.0, 0, 0])
    hides_less = props.in_the_way([beside], [middle], [2])
    assert not any(each.any() for each in hides_less.values())
    assert props.surfaces(2, beside, middle, -1.0, way) == [] != props.surfaces(2, beside, middle, -1.0, hides_less)


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
    figure = FigureBox.of(FIGURE)
    surfaces = props.surfaces(0, figure, CAMERA, -0.3, props.in_the_way([figure], [CAMERA], [0]))
    drawn = [surface.points[surface.faces][..., 1].max() for surface in surfaces]
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
