# SPDX-License-Identifier: Apache-2.0
"""Joints follow the skin of a body that takes another shape: against closed forms, and a slow regressor."""

import numpy as np
import pytest

from ssilk_core.scene.following_joints import following_moves, skinned_moves

HEIGHTS = np.array([1.0, 0.6, 0.2, 0.2, 0.0])  # hip, knee and ankle of a leg, an end joint in front, one without skin
JOINTS = np.stack([np.array([0.02, 0.01, 0, 0, 0.4]), HEIGHTS, np.array([0, 0, 0, 0.2, 0.1])], axis=1)
PARENTS = np.array([-1, 0, 1, 2, -1])
BLEND = 0.08  # [m] above and below knee and ankle, over which two joints share skin


def leg():
    """Return points (V, 3) of a leg with the joints that move them and their weights (V, 2)."""
    height, angle = (each.reshape(-1) for each in np.meshgrid(np.linspace(0, 1.1, 56), np.arange(9) * 2 * np.pi / 9))
    radius = 0.05 + 0.04 * height
    points = np.stack([radius * np.sin(angle), height, radius * np.cos(angle) + 0.01 * height**2], axis=1)
    thigh, foot = (((height - at) / (2 * BLEND) + 0.5).clip(0, 1) for at in HEIGHTS[1:3])
    upper = height > 0.4
    own = np.where(upper, 1, 2)  # the lower of the two joints that share a point
    higher = np.where(upper, thigh, foot)
    return points, np.stack([own - 1, own], axis=1), np.stack([higher, 1 - higher], axis=1)


POINTS, INDICES, WEIGHTS = leg()


def follow(change):
    return following_moves(JOINTS, PARENTS, POINTS, change(POINTS) - POINTS, INDICES, WEIGHTS)


AFFINE = {
    "moved": (lambda x: x + [0.1, -0.2, 0.3], 1e-12),
    "grown": (lambda x: 1.3 * x + [0.1, 0, 0], 1e-12),
    "stretched along it": (lambda x: x * [1, 1.2, 1], 1e-5),
    "sheared": (lambda x: x @ np.array([[1, 0.1, 0], [0, 1, 0.2], [0, 0, 0.9]]), 1e-5),
}


@pytest.mark.parametrize(("change", "off"), AFFINE.values(), ids=AFFINE)
def test_joints_move_as_a_body_that_changes_as_a_whole(change, off):
    np.testing.assert_allclose(JOINTS + follow(change), change(JOINTS), atol=off)


def longer(points, start=HEIGHTS[1] - BLEND, end=HEIGHTS[2] + BLEND):
    """The leg with 8 cm more between two heights, which the foot makes way for."""
    return points - [0, 0.08, 0] * ((start - points[:, 1:2]) / (start - end)).clip(0, 1)


def test_a_longer_shin_leaves_the_knee_and_moves_the_ankle_by_its_length():
    moves = follow(longer)
    np.testing.assert_allclose(moves[:2], 0, atol=1e-9)
    np.testing.assert_allclose(moves[2:4], [[0, -0.08, 0]] * 2, atol=1e-9)


def test_shin_that_is_stretched_from_the_knee_on_moves_the_knee_by_little():
    moves = follow(lambda points: longer(points, start=HEIGHTS[1], end=HEIGHTS[2]))
    assert 0 < -moves[1, 1] < 0.003 and abs(moves[2, 1] + 0.08) < 0.003


def test_shapes_add_up_and_so_do_joints():
    together = follow(lambda x: longer(x) + (1.2 * x - x))
    np.testing.assert_allclose(together, follow(longer) + follow(lambda x: 1.2 * x), atol=1e-12)
    assert not follow(lambda x: x).any()


def test_a_joint_is_the_mean_of_its_skin_that_a_least_squares_fit_makes(monkeypatch):
    """The slow twin: the affine map is fitted by all its entries, and the joint is a row of a regressor."""
    monkeypatch.setattr("ssilk_core.scene.following_joints.HELD", 0)
    moves = np.random.default_rng(1).normal(size=POINTS.shape)
    found = following_moves(JOINTS, PARENTS, POINTS, moves, INDICES, WEIGHTS)
    counts = np.where(INDICES[:, 1] == 2, WEIGHTS.prod(axis=1), 0)  # the ankle shares skin with the knee
    ones = np.c_[POINTS, np.ones(len(POINTS))]
    fitted = np.linalg.lstsq(np.sqrt(counts)[:, None] * ones, np.sqrt(counts)[:, None] * moves, rcond=None)[0]
    np.testing.assert_allclose(found[2], [*JOINTS[2], 1] @ fitted, atol=1e-9)


def test_a_ring_of_points_says_nothing_along_its_axis_and_grows_alike():
    ring = np.abs(POINTS[:, 1] - 0.2) < 1e-9
    above = JOINTS + [0, 0.1, 0]
    moves = following_moves(above, PARENTS, POINTS[ring], 0.5 * POINTS[ring], INDICES[ring], WEIGHTS[ring])
    np.testing.assert_allclose(moves[2], 0.5 * above[2], atol=1e-12)


def test_skin_goes_along_with_joints_that_move():
    moves = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 0], [0, 0, 0]], dtype=float)
    slow = [sum(weight * moves[joint] for joint, weight in zip(*row)) for row in zip(INDICES, WEIGHTS)]
    np.testing.assert_allclose(skinned_moves(moves, INDICES, WEIGHTS), slow, atol=1e-15)
