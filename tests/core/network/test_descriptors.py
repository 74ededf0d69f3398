# SPDX-License-Identifier: Apache-2.0
"""What the network sees of a motion: its symmetries, its limits and its first frames."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ssilk_core.network.descriptors import (
    RATE_TIME,
    SATURATION,
    descriptor_joints,
    pose_features,
    seen_gravity,
    six_d,
)
from ssilk_core.network.model.descriptors import gravity_features, motion_descriptors
from ssilk_core.network.model.descriptors import seen_gravity as seen_units
from ssilk_core.physics.constants import GRAVITY
from ssilk_core.scene.assets import Motion
from ssilk_core.scene.kinematics import matrix_from_quaternion, motion_transforms, quaternion_from_matrix

JOINTS = np.arange(3)
DOWN = np.array([0.0, -1.0, 0.0])


@pytest.fixture(scope="module")
def motion(scene, toy_motion) -> Motion:
    return toy_motion(scene, 40)


def moved(motion: Motion, turn: np.ndarray, shift: np.ndarray) -> Motion:
    """The motion with its root turned about the origin, then shifted; `shift` is (3,) or (F, 3)."""
    rotations, translations = motion.rotations.copy(), motion.translations.copy()
    rotations[:, 0] = quaternion_from_matrix(turn @ matrix_from_quaternion(rotations[:, 0]))
    translations[:, 0] = translations[:, 0] @ turn.T + shift
    return replace(motion, rotations=rotations, translations=translations)


def seen(motion: Motion, scene, down: np.ndarray = DOWN) -> np.ndarray:
    features = pose_features(motion, scene.character.skeleton, JOINTS)
    count = len(features.static)
    gravity = gravity_features(torch.tensor(features.down), torch.tensor(np.tile(down, (count, 1)))).numpy()
    return np.concatenate([features.static, features.dynamic, gravity], axis=1)


def test_sizes(scene, motion):
    features = pose_features(motion, scene.character.skeleton, JOINTS)
    assert features.static.shape == (40, 12) and features.down.shape == (40, 3, 3, 3)
    assert features.dynamic.shape == (40, 2 * 12 + 12 + 9)


@pytest.mark.parametrize("shift", [[100.0, -3, 7], [0.0, 0, 0]])
@pytest.mark.parametrize("yaw", [0.0, 1.0, np.pi])
def test_place_and_heading_do_not_matter(scene, motion, shift, yaw):
    turn = Rotation.from_rotvec([0, yaw, 0]).as_matrix()
    np.testing.assert_allclose(seen(moved(motion, turn, np.array(shift)), scene), seen(motion, scene), atol=1e-8)


def test_a_steady_glide_does_not_matter(scene, motion):
    glide = np.arange(40)[:, None] / 30 * [3.0, -1.0, 2.0]
    np.testing.assert_allclose(seen(moved(motion, np.eye(3), glide), scene), seen(motion, scene), atol=1e-8)


def test_turning_the_world_together_with_gravity_does_not_matter(scene, motion):
    turn = Rotation.random(random_state=2).as_matrix()
    turned = moved(motion, turn, np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(seen(turned, scene, turn @ DOWN), seen(motion, scene), atol=1e-8)
    assert np.abs(seen(turned, scene) - seen(motion, scene)).max() > 0.1  # under a fixed gravity it does


def test_static_part_is_the_six_d_of_local_rotations_of_all_but_the_root(scene, motion):
    q = motion.rotations[7, 1:]
    expected = Rotation.from_quat(q[:, [1, 2, 3, 0]]).as_matrix()[:, :, :2].transpose(0, 2, 1).reshape(-1)
    features = pose_features(motion, scene.character.skeleton, JOINTS)
    np.testing.assert_allclose(features.static[7], expected, atol=1e-12)
    np.testing.assert_allclose(six_d(np.eye(3)), [1, 0, 0, 0, 1, 0])


def test_gravity_is_its_direction_in_each_joints_frame(scene, motion):
    world = motion_transforms(motion, scene.character.skeleton.parents)[:, :, :3, :3]
    expected = np.einsum("fjab,a->fjb", world, DOWN).reshape(40, 9)
    np.testing.assert_allclose(seen(motion, scene)[:, -9:], expected, atol=1e-12)


def test_a_falling_root_is_seen_as_one_gravity(scene):
    time = np.arange(10)[:, None] / 30
    q = scene.character.skeleton.rest_transforms
    rotations = np.broadcast_to(quaternion_from_matrix(q[:, :3, :3]), (10, 3, 4))
    translations = np.broadcast_to(q[:, :3, 3], (10, 3, 3)).copy()
    translations[:, 0] += 0.5 * GRAVITY * time**2 * DOWN
    features = pose_features(Motion("/fall", 30.0, rotations, translations), scene.character.skeleton, JOINTS)
    acceleration = np.arctanh(features.dynamic[2:, -9:] / SATURATION) * SATURATION
    root = q[0, :3, :3]
    np.testing.assert_allclose(acceleration, np.tile(root.T @ DOWN, (8, 3)), atol=1e-9)
    np.testing.assert_allclose(features.dynamic[2:, :36], 0, atol=1e-9)


def test_rates_do_not_depend_on_the_frame_rate(scene, toy_motion):
    slow, fast = (
        pose_features(toy_motion(scene, n, fps), scene.character.skeleton, JOINTS)
        for n, fps in ((61, 60), (121, 120))
    )
    np.testing.assert_allclose(slow.dynamic[10::10, :12], fast.dynamic[20::20, :12], atol=0.02)
    assert np.abs(slow.dynamic[10::10, :12]).max() > 0.05


def test_turning_is_seen_in_the_roots_own_frame(scene):
    rest = scene.character.skeleton.rest_transforms
    speed, fps, frames = 2.0, 30.0, 6
    turns = Rotation.from_rotvec(np.outer(np.arange(frames) * speed / fps, [0, 1, 0])).as_matrix()
    rotations = np.broadcast_to(rest[:, :3, :3], (frames, 3, 3, 3)).copy()
    rotations[:, 0] = turns @ rest[0, :3, :3]
    translations = np.broadcast_to(rest[:, :3, 3], (frames, 3, 3))
    motion = Motion("/turn", fps, quaternion_from_matrix(rotations), translations)
    found = pose_features(motion, scene.character.skeleton, JOINTS).dynamic[3:, 24:36]
    root = rest[0, :3, :3]
    expected = []
    for steps in (1, 2):
        back = Rotation.from_rotvec([0, -steps * speed / fps, 0]).as_matrix()
        expected.append(six_d(root.T @ back @ root - np.eye(3)) * fps * RATE_TIME)
    expected = SATURATION * np.tanh(np.concatenate(expected) / SATURATION)
    np.testing.assert_allclose(found, np.tile(expected, (3, 1)), atol=1e-12)


def test_a_teleport_saturates(scene, motion):
    jump = np.where(np.arange(40)[:, None] >= 20, [1e6, 0, 0], [0.0, 0, 0])
    features = pose_features(moved(motion, np.eye(3), jump), scene.character.skeleton, JOINTS)
    assert np.abs(features.dynamic).max() <= SATURATION
    assert np.abs(features.dynamic[20, -9:]).max() == pytest.approx(SATURATION, abs=1e-6)


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_first_frames_are_defined_and_agree_with_longer_histories(scene, motion, frames):
    short = pose_features(motion.clip(5, 5 + frames), scene.character.skeleton, JOINTS)
    assert np.isfinite(short.dynamic).all() and short.dynamic.shape[0] == frames
    whole = pose_features(motion, scene.character.skeleton, JOINTS)
    np.testing.assert_allclose(short.static, whole.static[5 : 5 + frames])
    np.testing.assert_allclose(short.dynamic[2:], whole.dynamic[7 : 5 + frames], atol=1e-12)
    np.testing.assert_allclose(short.dynamic[:2, -9:], 0)  # no acceleration without a past


def test_joints_in_view_keep_their_ancestors(scene):
    skeleton = scene.character.skeleton
    assert descriptor_joints(skeleton, [False, False, True]).tolist() == [0, 1, 2]
    assert descriptor_joints(skeleton, [False, True, False]).tolist() == [0, 1]
    assert descriptor_joints(skeleton, [True, False, False]).tolist() == [0]
    assert descriptor_joints(skeleton, [False, False, False]).tolist() == []


def test_gravity_is_seen_as_it_is_up_to_its_usual_strength_and_then_by_its_logarithm():
    along = np.array([0.6, 0.0, -0.8])
    lengths = np.array([0.0, 0.3, 1.0, np.e, 10.0])
    found = seen_gravity(GRAVITY * lengths[:, None] * along)
    expected = [0.0, 0.3, 1.0, 2.0, 1 + np.log(10)]
    np.testing.assert_allclose(found, np.outer(expected, along), atol=1e-12)
    step = np.linalg.norm(seen_gravity(GRAVITY * np.outer([1 - 1e-6, 1, 1 + 1e-6], along)), axis=1)
    np.testing.assert_allclose(np.diff(step), 1e-6, rtol=1e-4)  # without a kink
    units = torch.tensor(np.outer(lengths, along))
    np.testing.assert_allclose(seen_units(units), found, atol=1e-12)


def test_a_motions_own_gravity_is_what_its_descriptors_hold(scene, motion):
    felt = np.random.default_rng(3).normal(size=(40, 3)) * 15
    found = motion_descriptors(
        pose_features(replace(motion, gravity=felt), scene.character.skeleton, JOINTS), torch.zeros(1).double()
    )
    world = motion_transforms(motion, scene.character.skeleton.parents)[:, :, :3, :3]
    expected = np.einsum("fjab,fa->fjb", world, seen_gravity(felt)).reshape(40, 9)
    np.testing.assert_allclose(found[0][:, 12:], expected, atol=1e-12)
    np.testing.assert_allclose(found[1][:, 12:21], expected, atol=1e-12)
    usual = motion_descriptors(
        pose_features(replace(motion, gravity=np.tile(GRAVITY * DOWN, (40, 1))), scene.character.skeleton, JOINTS),
        torch.zeros(1).double(),
    )
    without = motion_descriptors(pose_features(motion, scene.character.skeleton, JOINTS), torch.zeros(1).double())
    for one, other in zip(usual, without):
        np.testing.assert_allclose(one, other, atol=1e-15)
