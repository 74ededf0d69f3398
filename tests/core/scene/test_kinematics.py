# SPDX-License-Identifier: Apache-2.0
"""Rotations, forward kinematics and skinning against independent references."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from ssilk_core.scene import kinematics
from ssilk_core.scene.assets import Motion, SkinWeights

RNG = np.random.default_rng(7)


def random_quaternions(*shape: int) -> np.ndarray:
    q = RNG.normal(size=(*shape, 4))
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def as_scipy(q: np.ndarray) -> Rotation:
    return Rotation.from_quat(q[..., [1, 2, 3, 0]])


def test_matrix_from_quaternion_matches_scipy():
    q = random_quaternions(500)
    np.testing.assert_allclose(kinematics.matrix_from_quaternion(q), as_scipy(q).as_matrix(), atol=1e-14)


def test_quaternion_from_matrix_inverts_even_at_half_turns():
    half_turns = np.concatenate([np.zeros((50, 1)), RNG.normal(size=(50, 3))], axis=1)
    half_turns /= np.linalg.norm(half_turns, axis=1, keepdims=True)
    q = np.concatenate([random_quaternions(500), half_turns, np.eye(4)])
    back = kinematics.quaternion_from_matrix(kinematics.matrix_from_quaternion(q))
    np.testing.assert_allclose(np.abs(np.sum(back * q, axis=1)), 1, atol=1e-14)


def test_multiply_quaternions_matches_matrix_product():
    p, q = random_quaternions(100), random_quaternions(100)
    product = kinematics.matrix_from_quaternion(kinematics.multiply_quaternions(p, q))
    expected = kinematics.matrix_from_quaternion(p) @ kinematics.matrix_from_quaternion(q)
    np.testing.assert_allclose(product, expected, atol=1e-14)


def test_slerp_matches_scipy_and_takes_the_shorter_way():
    p, q = random_quaternions(2)
    times = np.linspace(0, 1, 11)
    expected = Slerp([0, 1], as_scipy(np.stack([p, q])))(times).as_matrix()
    for sign in (1, -1):
        mixed = kinematics.slerp(np.tile(p, (11, 1)), np.tile(sign * q, (11, 1)), times)
        np.testing.assert_allclose(kinematics.matrix_from_quaternion(mixed), expected, atol=1e-12)


def test_world_and_local_transforms_invert_each_other():
    parents = np.array([-1, 0, 1, 1, 0, -1])
    local = kinematics.rigid(kinematics.matrix_from_quaternion(random_quaternions(3, 6)), RNG.normal(size=(3, 6, 3)))
    world = kinematics.world_transforms(local, parents)
    np.testing.assert_allclose(world[:, 3], local[:, 0] @ local[:, 1] @ local[:, 3], atol=1e-12)
    np.testing.assert_allclose(kinematics.local_transforms(world, parents), local, atol=1e-12)


def test_skin_points_is_the_weighted_mean_of_rigid_images():
    matrices = kinematics.rigid(
        kinematics.matrix_from_quaternion(random_quaternions(4, 3)), RNG.normal(size=(4, 3, 3))
    )
    points = RNG.normal(size=(10, 3))
    dense = RNG.random((10, 3))
    skin = SkinWeights.from_dense("test", dense)
    expected = np.zeros((4, 10, 3))
    for frame in range(4):
        for vertex in range(10):
            for joint in range(3):
                image = matrices[frame, joint] @ np.append(points[vertex], 1)
                expected[frame, vertex] += dense[vertex, joint] / dense[vertex].sum() * image[:3]
    np.testing.assert_allclose(kinematics.skin_points(points, skin, matrices), expected, atol=1e-12)


@pytest.mark.parametrize("count", range(1, 17))
def test_influences_are_sorted_and_sum_to_one_also_where_they_are_equal(count):
    """The rounding of equal weights goes to one of them, which may then be the lightest: 0.333333313, not ...343."""
    joints = np.arange(count)
    alike = np.where(joints % 2, 1.0, 1.0 + 1e-9)  # equal in float32 alone
    ties = np.stack([np.ones(count), joints < max(1, count - 1), alike])
    indices, weights = kinematics.sorted_influences(SkinWeights("x", np.tile(joints, (3, 1)), ties))
    assert (np.diff(weights, axis=1) <= 0).all() and (weights.sum(axis=1, dtype=np.float64) == 1).all()
    for row in np.where(weights > 0, indices, -1 - np.arange(indices.shape[1])):
        assert len(set(row)) == len(row)


@pytest.mark.parametrize("source, target", [(60, 30), (24, 30), (30, 25), (30, 30)])
def test_resample_keeps_duration_and_hits_a_steady_turn(source, target):
    frames = 2 * source + 1
    angle = np.linspace(0, 3, frames)
    rotations = np.stack([np.cos(angle / 2), np.zeros(frames), np.sin(angle / 2), np.zeros(frames)], axis=-1)[:, None]
    translations = np.linspace([0, 0, 0], [4, 2, 0], frames)[:, None]
    motion = kinematics.resample(Motion("test", source, rotations, translations), target)
    assert motion.fps == target and motion.frame_count == 2 * target + 1
    time = np.arange(motion.frame_count) / target / 2
    np.testing.assert_allclose(motion.translations[:, 0, 0], 4 * time, atol=1e-12)
    np.testing.assert_allclose(
        2 * np.arctan2(motion.rotations[:, 0, 2], motion.rotations[:, 0, 0]), 3 * time, atol=1e-9
    )


def test_a_run_up_comes_from_rest_to_the_pace_of_a_steady_turn():
    fps, pace = 40.0, 0.1  # easing takes 10 frames, in which the joint turns by as much as in 5 at full pace
    turns = Rotation.from_rotvec(np.arange(5)[:, None] * [0, 0, pace]).as_quat()[:, [3, 0, 1, 2]]
    places = np.arange(5)[:, None, None] * [[1.0, 0, 0]]
    before = kinematics.run_up(Motion("turn", fps, turns[:, None], places), 1.0)
    angles = as_scipy(before.rotations[:, 0]).as_rotvec()[:, 2] / pace
    np.testing.assert_allclose(angles, before.translations[:, 0, 0], atol=1e-9)
    steps = np.diff(np.append(angles, 0.0))
    np.testing.assert_allclose(angles[:31], -5.0, atol=1e-9)
    np.testing.assert_allclose(steps[30:], np.arange(0.05, 1.0, 0.1), atol=1e-9)
    assert before.frame_count == 40


def test_a_run_up_to_a_single_pose_holds_it():
    motion = Motion("pose", 30.0, np.array([[[0.6, 0.8, 0, 0]]]), np.ones((1, 1, 3)))
    before = kinematics.run_up(motion, 0.5)
    assert before.frame_count == 15
    np.testing.assert_allclose(before.rotations, np.broadcast_to(motion.rotations, (15, 1, 4)), atol=1e-12)
    np.testing.assert_allclose(before.translations, 1.0)
