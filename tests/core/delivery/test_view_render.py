# SPDX-License-Identifier: Apache-2.0
"""Pictures against closed forms: silhouettes, order in depth, shadows, sides of cloth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from ssilk_core.delivery.view.camera import Camera
from ssilk_core.delivery.view.light import LAMP_RADIUS, Lighting, sky_directions
from ssilk_core.delivery.view.render import render
from ssilk_core.delivery.view.surface import INSIDE_SHADE, Surface
from ssilk_core.errors import SsilkError

RED, GREEN, BLUE, GREY = np.eye(3)[0], np.eye(3)[1], np.eye(3)[2], np.full(3, 0.6)
WIDTH, HEIGHT = 240, 200
FAR_BELOW = -50.0
AHEAD = Camera(np.array([0.0, 0.0, 6.0]), np.zeros(3), fov=40.0)


def ball(centre, radius: float, colour=RED, *, name: str = "ball") -> Surface:
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    return Surface(name, mesh.vertices + centre, mesh.faces, colour)


def sheet(colour, *, z: float = 0.0, size: float = 1.0, two_sided: bool = True) -> Surface:
    """A square that faces +z."""
    points = np.array([[-size, -size, z], [size, -size, z], [size, size, z], [-size, size, z]])
    return Surface("sheet", points, np.array([[0, 1, 2], [0, 2, 3]]), colour, two_sided=two_sided)


def hue_mask(image: np.ndarray, channel: int) -> np.ndarray:
    """Where one channel clearly stands out; the stage is grey."""
    others = np.delete(image.astype(int), channel, axis=2).max(axis=2)
    return image[..., channel] > 1.3 * others + 5


@pytest.mark.parametrize("centre", [(0.0, 0.0, 0.0), (1.2, -0.6, 1.0)], ids=["centre", "off axis"])
def test_a_sphere_covers_its_projected_ellipse(centre):
    radius = 0.8
    mask = hue_mask(render([ball(centre, radius)], AHEAD, WIDTH, HEIGHT, samples=1, ground=FAR_BELOW), 0)
    away = np.asarray(centre) - AHEAD.position
    sine = radius / np.linalg.norm(away)  # of the cone that touches the sphere
    cosine = np.sqrt(1 - sine**2)
    axis = -away[2] / np.linalg.norm(away)  # cosine between that cone and the view
    focal = HEIGHT / 2 / np.tan(np.radians(AHEAD.fov) / 2)
    area = np.pi * focal**2 * sine**2 * cosine / (axis**2 - sine**2) ** 1.5
    # Pixels on the edge fall in or out at random (a standard error of 0.3 %); the mesh is smaller by 0.1 %.
    assert mask.sum() == pytest.approx(area, rel=0.012)


def test_a_sphere_stands_where_it_projects_to():
    centre = np.array([0.9, 0.5, 0.0])
    mask = hue_mask(render([ball(centre, 0.2)], AHEAD, WIDTH, HEIGHT, samples=1, ground=FAR_BELOW), 0)
    rows, columns = np.nonzero(mask)
    pixel, _ = AHEAD.project(centre[None], WIDTH, HEIGHT)
    np.testing.assert_allclose([columns.mean() + 0.5, rows.mean() + 0.5], pixel[0], atol=0.5)


def test_what_is_behind_is_hidden_whatever_the_order():
    front, behind = sheet(GREEN, z=1.0), ball((0.0, 0.0, -1.0), 0.5, RED)
    for surfaces in ([front, behind], [behind, front]):
        image = render(surfaces, AHEAD, WIDTH, HEIGHT, ground=FAR_BELOW)
        assert hue_mask(image, 1).any() and not hue_mask(image, 0).any()


def test_the_floor_hides_what_is_below_it():
    image = render([ball((0.0, -1.0, 0.0), 0.4)], AHEAD, WIDTH, HEIGHT, ground=-0.5)
    assert not hue_mask(image, 0).any()


def test_the_shadow_falls_where_the_lamp_is_hidden():
    camera = Camera(np.array([0.0, 5.0, 9.0]), np.array([0.0, 0.5, 0.0]), fov=45.0)
    centre, radius = np.array([0.0, 1.8, 0.0]), 0.35
    shaded = render([ball(centre, radius)], camera, WIDTH, HEIGHT).astype(float).sum(axis=2)
    # The same floor, with the ball out of the way.
    bare = render([ball((0.0, 50.0, 0.0), radius)], camera, WIDTH, HEIGHT).astype(float).sum(axis=2)
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = camera.directions(x, y, WIDTH, HEIGHT)
    floor = camera.position - camera.position[1] / rays[..., 1:2] * rays
    key = Lighting.for_camera(camera).key
    apart = np.linalg.norm(np.cross(centre - floor, key), axis=-1)  # from the ball's centre to the ray at the lamp
    seen = (rays[..., 1] < 0) & (np.linalg.norm(np.cross(centre - camera.position, rays), axis=-1) > 1.1 * radius)
    penumbra = 1.2 * LAMP_RADIUS * centre[1] / key[1]
    core, clear = seen & (apart < radius - penumbra), seen & (apart > radius + penumbra)
    assert core.sum() > 50 and clear.sum() > 1000
    assert (shaded[core] < 0.85 * bare[core]).all()
    assert (shaded[clear] > 0.93 * bare[clear]).all()


def test_surfaces_cast_shadows_on_each_other():
    key = Lighting.for_camera(AHEAD).key
    alone = render([sheet(GREY)], AHEAD, WIDTH, HEIGHT, ground=FAR_BELOW)
    # A ball outside the picture, between the middle of the sheet and the lamp.
    shaded = render([sheet(GREY), ball(8 * key, 0.6)], AHEAD, WIDTH, HEIGHT, ground=FAR_BELOW)
    middle = np.s_[HEIGHT // 2 - 3 : HEIGHT // 2 + 3, WIDTH // 2 - 3 : WIDTH // 2 + 3]
    assert shaded[middle].mean() < 0.8 * alone[middle].mean()


def test_cloth_is_darker_inside():
    behind = Camera(np.array([0.0, 0.0, -6.0]), np.zeros(3), fov=40.0)
    middle = HEIGHT // 2, WIDTH // 2, 2
    outside = render([sheet(BLUE)], AHEAD, WIDTH, HEIGHT, ground=FAR_BELOW)[middle]
    inside = render([sheet(BLUE)], behind, WIDTH, HEIGHT, ground=FAR_BELOW)[middle]
    # The lamps go with the camera, so that only the darker inside tells the sides apart.
    assert inside / outside == pytest.approx(INSIDE_SHADE ** (1 / 2.2), abs=0.04)


def test_shadows_on_the_inside_of_cloth_do_not_show_its_faces():
    """A trough whose inside is seen: coarse faces are lit as fine ones."""
    pictures = []
    for columns in (14, 200):
        angle, height = np.radians(np.linspace(-85, 85, columns)), np.linspace(-1, 1, 7)
        points = np.array([[np.sin(a), y, -np.cos(a)] for a in angle for y in height])
        first = (np.arange(columns - 1)[:, None] * 7 + np.arange(6)).reshape(-1)
        halves = [first, first + 8, first + 7], [first, first + 1, first + 8]
        trough = Surface(
            "trough", points, np.concatenate([np.stack(half, 1) for half in halves]), GREY, two_sided=True
        )
        pictures.append(render([trough], AHEAD, WIDTH, HEIGHT, ground=FAR_BELOW).astype(int))
    middle = np.s_[HEIGHT // 4 : 3 * HEIGHT // 4, WIDTH // 2 - 42 : WIDTH // 2 + 42]
    away = np.abs(pictures[0][middle] - pictures[1][middle])
    assert np.percentile(away, 95) < 10  # all but the edge of the shadow that its rim casts


def test_smooth_normals_hide_the_facets():
    coarse = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
    image = render([Surface("ball", coarse.vertices, coarse.faces, GREY)], AHEAD, WIDTH, HEIGHT, ground=FAR_BELOW)
    fine = render([ball((0, 0, 0), 1.0, GREY)], AHEAD, WIDTH, HEIGHT, ground=FAR_BELOW)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    inner = np.hypot(y + 0.5 - HEIGHT / 2, x + 0.5 - WIDTH / 2) < 0.15 * HEIGHT
    assert np.abs(image[inner].astype(int) - fine[inner]).max() < 14


def test_edges_are_smooth_with_four_samples():
    turn = np.array([[np.cos(0.3), np.sin(0.3), 0], [-np.sin(0.3), np.cos(0.3), 0], [0, 0, 1]])
    flat = sheet(np.zeros(3), two_sided=False)
    surfaces = [replace(flat, points=flat.points @ turn)]
    hard, soft = (render(surfaces, AHEAD, WIDTH, HEIGHT, samples=n, ground=FAR_BELOW)[..., 0] for n in (1, 4))
    # The sheet is black and the stage brighter than 150: only a mixed pixel lies between.
    assert ((soft > 80) & (soft < 140)).sum() > 30
    assert ((hard > 80) & (hard < 140)).sum() == 0


def test_pictures_are_the_same_each_time():
    surfaces = [ball((0.0, 0.5, 0.0), 0.5), sheet(GREEN, z=-0.5)]
    first, second = (render(surfaces, AHEAD, WIDTH, HEIGHT) for _ in range(2))
    assert first.shape == (HEIGHT, WIDTH, 3) and first.dtype == np.uint8
    assert first.tobytes() == second.tobytes()


def test_what_is_out_of_view_leaves_the_stage_alone():
    image = render([ball((0.0, 0.0, 40.0), 0.5)], AHEAD, WIDTH, HEIGHT, ground=FAR_BELOW)
    assert np.ptp(image.astype(int), axis=2).max() < 30


def test_sky_directions_are_even():
    directions = sky_directions(64)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-6)
    # For an even spread the second moments are those of the sphere: a third of the identity.
    np.testing.assert_allclose(directions.T @ directions / 64, np.eye(3) / 3, atol=0.01)


@pytest.mark.parametrize(
    ("surfaces", "samples", "message"), [([], 4, "have no faces"), ([sheet(GREY)], 3, "3 samples")]
)
def test_nothing_to_draw_and_unknown_samples(surfaces, samples, message):
    with pytest.raises(SsilkError, match=message):
        render(surfaces, AHEAD, WIDTH, HEIGHT, samples=samples)
