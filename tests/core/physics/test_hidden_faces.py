# SPDX-License-Identifier: Apache-2.0
"""Only skin that cloth covers in every frame may be hidden: a pillar in a shorter tube."""

from __future__ import annotations

import numpy as np
import pytest

from ssilk_core.physics.skin.blocked_rays import BLOCK, NO_TRIANGLE, BlockedRays
from ssilk_core.physics.skin.hidden_faces import APART, HiddenFaces
from ssilk_core.scene.assets import Mesh

RADIUS, GAP, LOW, HIGH = 0.12, 0.01, 0.5, 1.1
MARGIN = APART  # from an opening, of what may be hidden; under so close a cloth, rays ask for less


def tube(radius: float, low: float, high: float, columns: int = 32, rows: int = 40) -> Mesh:
    angle, y = np.arange(columns) * 2 * np.pi / columns, np.linspace(low, high, rows)[:, None]
    points = np.stack(np.broadcast_arrays(radius * np.sin(angle), y, radius * np.cos(angle)), -1).reshape(-1, 3)
    row, column = (part.reshape(-1) for part in np.mgrid[0 : rows - 1, 0:columns])
    a, b = row * columns + column, row * columns + (column + 1) % columns
    return Mesh("/tube", points, np.concatenate([np.c_[a, b, b + columns], np.c_[a, b + columns, a + columns]]))


BODY, CLOTH = tube(RADIUS, 0.2, 1.4, rows=61), tube(RADIUS + GAP, LOW, HIGH)


def heights(found: HiddenFaces) -> np.ndarray:
    """Return the heights of the corners of what may be hidden [m]."""
    return BODY.points[BODY.faces[found.mask()]][..., 1]


def around(angle: float, height: float, radius: float, mesh: Mesh) -> np.ndarray:
    """Return which vertices lie within a distance of a place on the tube."""
    place = [(RADIUS + GAP) * np.sin(angle), height, (RADIUS + GAP) * np.cos(angle)]
    return np.linalg.norm(mesh.points - place, axis=1) < radius


def test_what_lies_well_under_the_cloth_is_hidden_and_nothing_near_its_ends():
    found = heights(HiddenFaces(BODY, CLOTH))
    assert LOW + MARGIN <= found.min() < LOW + MARGIN + 0.05
    assert HIGH - MARGIN - 0.05 < found.max() <= HIGH - MARGIN
    between = (BODY.points[:, 1] >= found.min()) & (BODY.points[:, 1] <= found.max())
    assert len(found) == between[BODY.faces].all(axis=1).sum()


def test_cloth_that_moves_hides_what_it_covers_in_every_frame():
    found = HiddenFaces(BODY, CLOTH)
    before = found.mask()
    for shift in (0.05, 0.1, 0.2, 0.1):
        found.add(BODY.points, CLOTH.points + [0, shift, 0])
    assert found.mask().sum() < before.sum() and not (found.mask() & ~before).any()
    assert heights(found).min() >= LOW + 0.2 + MARGIN


def test_the_frames_of_both_may_move_and_turn_far_from_the_origin():
    found, turn = HiddenFaces(BODY, CLOTH), np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    before = found.mask()
    found.add(BODY.points @ turn + 50, CLOTH.points @ turn + 50)
    assert np.array_equal(found.mask(), before)


def test_a_hole_shows_the_skin_around_it():
    torn = around(0, 0.8, 0.03, CLOTH)
    found = HiddenFaces(BODY, Mesh("/torn", CLOTH.points, CLOTH.faces[~torn[CLOTH.faces].any(axis=1)]))
    hidden = BODY.points[BODY.faces[found.mask()]].reshape(-1, 3)
    away = np.linalg.norm(hidden - [0, 0.8, RADIUS], axis=1)
    assert MARGIN < away.min() < MARGIN + 0.08
    assert (hidden[:, 2] < 0).any()


def test_cloth_out_of_reach_hides_nothing():
    assert not HiddenFaces(BODY, tube(RADIUS + 0.09, 0, 1.6)).mask().any()
    away = HiddenFaces(BODY, CLOTH)
    away.add(BODY.points, CLOTH.points * [1.8, 1, 1.8])
    assert not away.mask().any()


@pytest.mark.parametrize("depth", [0.004, 0.012])
def test_skin_that_shows_through_covered_cloth_is_hidden(depth):
    found = HiddenFaces(BODY, CLOTH)
    before = found.mask()
    found.add(BODY.points, dented(depth))
    through = np.linalg.norm(BODY.points - [0, 0.8, RADIUS], axis=1) < 0.06
    chosen = through[BODY.faces].all(axis=1)
    assert before[chosen].all() and found.mask()[chosen].all()


def test_cloth_deep_in_the_body_does_not_cover_it():
    found = HiddenFaces(BODY, CLOTH)
    found.add(BODY.points, dented(0.04))
    middle = np.linalg.norm(BODY.points - [0, 0.8, RADIUS], axis=1) < 0.02
    assert not found.mask()[middle[BODY.faces].any(axis=1)].any() and found.mask().any()


def dented(depth: float) -> np.ndarray:
    """Return the points of the tube with a dent of 16 cm, which lies this deep in the body in its middle [m]."""
    away = np.linalg.norm(CLOTH.points - [0, 0.8, RADIUS + GAP], axis=1)
    dent = (depth + GAP) * np.cos(away.clip(max=0.08) / 0.08 * np.pi / 2) ** 2
    return CLOTH.points * (1 - dent / (RADIUS + GAP))[:, None] ** [1, 0, 1]


def test_cloth_behind_a_thin_limb_does_not_cover_its_other_side():
    plank = tube(0.012, 0, 1.0, columns=12)
    sheet = Mesh("/sheet", *_sheet(np.array([0, 0.5, -0.014])))
    assert not HiddenFaces(plank, sheet).covered[plank.points[plank.faces][..., 2].min(axis=1) > 0].any()


def _sheet(middle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 40), np.linspace(-0.8, 0.8, 60), indexing="ij")
    points = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3) + middle
    a = (np.arange(39)[:, None] * 60 + np.arange(59)).reshape(-1)
    return points, np.concatenate([np.c_[a, a + 60, a + 1], np.c_[a + 60, a + 61, a + 1]])


def test_no_triangles_block_no_rays():
    rays = BlockedRays(np.zeros((0, 3)), np.zeros((0, 3), dtype=int))
    assert rays.blocks.shape == (0, BLOCK)
    ends = np.zeros(2), np.ones(2)
    found, distances = rays.find(np.zeros((0, 3)), np.zeros((2, 3)), np.eye(3)[:2], *ends, np.full(2, NO_TRIANGLE))
    assert (found == NO_TRIANGLE).all() and np.isinf(distances).all()


def test_rays_are_blocked_as_trying_every_triangle_says():
    """From frame to frame, and from any guess."""
    random, mesh = np.random.default_rng(4), tube(0.3, 0, 1, columns=16, rows=12)
    rays = BlockedRays(mesh.points, mesh.faces)
    starts = random.uniform([-0.5, 0, -0.5], [0.5, 1, 0.5], (400, 3))
    directions = random.normal(size=(400, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    low, high = np.full(400, -0.1), np.full(400, 0.4)
    guesses = random.integers(-1, len(mesh.faces), 400)
    for frame in range(3):
        points = mesh.points + 0.02 * frame * np.sin(7 * mesh.points[:, [1, 2, 0]])
        guesses, distances = rays.find(points, starts, directions, low, high, guesses)
        corners = points[mesh.faces]
        matrices = np.stack(
            [corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0], np.zeros_like(corners[:, 0])], axis=-1
        )[None].repeat(400, axis=0)
        matrices[..., 2] = -directions[:, None]
        away = (starts[:, None] - corners[:, 0])[..., None]
        u, v, t = np.moveaxis(np.linalg.solve(matrices, away)[..., 0], -1, 0)
        meets = (np.minimum(np.minimum(u, v), 1 - u - v) >= 0) & (t >= -0.1) & (t <= 0.4)
        assert np.array_equal(guesses != NO_TRIANGLE, meets.any(axis=1))
        assert 20 < meets.any(axis=1).sum() < 380
        hit = np.flatnonzero(guesses != NO_TRIANGLE)
        np.testing.assert_allclose(distances[hit], t[hit, guesses[hit]], atol=1e-9)
