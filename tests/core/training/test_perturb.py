# SPDX-License-Identifier: Apache-2.0
"""Perturbed motions, and the loss in which poses without good states count less."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ssilk_core.scene.assets import Motion, Skeleton
from ssilk_core.scene.kinematics import (
    local_transforms,
    matrix_from_quaternion,
    motion_transforms,
    multiply_quaternions,
    quaternion_from_matrix,
)
from ssilk_core.training import perturb
from ssilk_core.training.objective import REGULARIZATION, total
from ssilk_core.training.perturb import perturb_motions


def test_every_joint_but_the_root_turns_and_alike_for_a_seed(scene, toy_motion):
    motions, skeleton = [toy_motion(scene, 40), toy_motion(scene, 25, speed=2.0)], scene.character.skeleton
    found, again = (perturb_motions(motions, skeleton, 2, 3, 0.0) for _ in range(2))
    assert len(found) == 4 and perturb_motions(motions, skeleton, 0, 3, 0.0) == []
    for motion, other, base in zip(found, again, motions * 2, strict=True):
        np.testing.assert_array_equal(motion.rotations, other.rotations)
        np.testing.assert_allclose(np.linalg.norm(motion.rotations, axis=-1), 1)
        np.testing.assert_allclose(motion.rotations[:, 0], base.rotations[:, 0], atol=1e-12)
        assert np.array_equal(motion.translations, base.translations)
        turn = angles(motion.rotations, base.rotations)[:, 1:]
        assert (turn.mean(axis=0) > 0.02).all() and np.abs(np.diff(turn, axis=0)).max() < 0.5
    assert not np.array_equal(found[0].rotations, found[2].rotations)


def test_about_half_of_the_motions_go_to_and_fro_between_their_poses_and_the_bind_pose(scene, toy_motion):
    skeleton = scene.character.skeleton  # without limbs: all joints go all the way
    bind = quaternion_from_matrix(local_transforms(skeleton.bind_transforms, skeleton.parents)[:, :3, :3])
    found = perturb_motions([toy_motion(scene, 400)], skeleton, 60, 1, 0.0)
    near = np.array([angles(m.rotations, bind)[:, 1:].max(axis=1).min() for m in found])
    assert 20 <= (near < 0.01).sum() <= 40
    blended = found[near.argmin()]
    assert np.median(angles(blended.rotations, bind)[:, 1:].max(axis=1)) > 0.1
    assert max(np.abs(np.diff(angles(m.rotations, bind)[:, 1:], axis=0)).max() for m in found) < 0.3


def test_limbs_go_their_own_parts_of_the_way_and_the_root_goes_none(monkeypatch):
    for name, value in {"USUAL_TURN": 0, "LARGE_TURN": 0, "BLEND_PROBABILITY": 1}.items():
        monkeypatch.setattr(perturb, name, value)
    names = ("Hips", "Hips/Leg", "Hips/Spine", "Hips/Spine/Arm", "Hips/Spine/Arm/Hand", "Hips/Spine/Head")
    bind = np.tile(np.eye(4), (6, 1, 1))
    skeleton = Skeleton("/toy", names, np.array([-1, 0, 0, 2, 3, 2]), bind, bind)
    turned = np.tile([np.cos(0.4), np.sin(0.4), 0, 0], (600, 6, 1))
    parts = []
    for motion in perturb_motions([Motion("/toy", 30.0, turned, np.zeros((600, 6, 3)))], skeleton, 40, 5, 0.0):
        way = 1 - angles(motion.rotations, [1, 0, 0, 0]) / 0.8
        np.testing.assert_allclose(way[:, 0], 0, atol=1e-9)
        np.testing.assert_allclose(way[:, 3], way[:, 4], atol=1e-9)  # a hand goes with its arm
        parts.append(way.max(axis=0)[[1, 2, 3, 5]])
    parts = np.array(parts)
    assert ((parts > 0.99).mean(axis=0) > 0.3).all() and ((parts < 0.9).mean(axis=0) > 0.25).all()
    assert len({tuple(row > 0.99) for row in parts}) > 6  # independently


def test_a_joint_that_turns_past_the_far_side_of_the_bind_pose_does_not_jump():
    angle = np.linspace(0, 4 * np.pi, 240)
    rotations = np.stack([np.cos(angle / 2), 0 * angle, np.sin(angle / 2), 0 * angle], axis=-1)[:, None]
    found = perturb._towards(rotations, np.array([[1.0, 0, 0, 0]]), np.full((240, 1), 0.7))
    assert angles(found[1:], found[:-1]).max() < 5 * (angle[1] - angle[0])
    half = angles(rotations, [1, 0, 0, 0]) < np.radians(115)
    np.testing.assert_allclose(
        angles(found, [1, 0, 0, 0])[half], 0.3 * angles(rotations, [1, 0, 0, 0])[half], atol=1e-6
    )


def test_a_share_of_the_motions_turns_over_as_a_whole_and_starts_upright(scene, toy_motion):
    base, parents = toy_motion(scene, 300), scene.character.skeleton.parents
    found = perturb_motions([base], scene.character.skeleton, 60, 1, 0.4)
    turned = np.array([angles(motion.rotations[:, 0], base.rotations[:, 0]) for motion in found])
    over = turned.max(axis=1) > np.radians(150)
    assert 15 <= over.sum() <= 33 and (turned[~over] < 1e-6).all()
    assert (turned[:, 0] < np.radians(3)).all() and np.abs(np.diff(turned, axis=1)).max() < 2 * np.pi * 1.5 / 0.6 / 30
    back = base.rotations[:, 0] * [1, -1, -1, -1]
    turns = (multiply_quaternions(motion.rotations[:, 0], back) for motion, turns in zip(found, over) if turns)
    lowest = np.array([matrix_from_quaternion(turn)[:, 1, 1].min() for turn in turns])
    assert (lowest < -0.5).mean() > 0.5  # upside down
    moved = np.array([middle(motion, parents) - middle(straight(motion, base), parents) for motion in found])
    np.testing.assert_allclose(moved[..., [0, 2]], 0, atol=1e-9)  # about the middle
    aloft = moved[..., 1] > 1e-3
    assert not aloft[~over].any() and 0.05 < aloft[over].mean() < 0.4 and (moved[..., 1] > -1e-9).all()


def middle(motion: Motion, parents: np.ndarray) -> np.ndarray:
    """The mean place of the joints in each frame, shape (F, 3)."""
    return motion_transforms(motion, parents)[:, :, :3, 3].mean(axis=1)


def straight(motion: Motion, base: Motion) -> Motion:
    """The motion with its root as it was before it turned."""
    rotations, translations = motion.rotations.copy(), motion.translations.copy()
    rotations[:, 0], translations[:, 0] = base.rotations[:, 0], base.translations[:, 0]
    return replace(motion, rotations=rotations, translations=translations)


SIDEWAYS = np.tile([np.sqrt(0.5), 0, np.sqrt(0.5), 0], (480, 2, 1))


@pytest.fixture
def tumbled(monkeypatch) -> Motion:
    """A motion of four seconds at 120 Hz that turns, hops, and does nothing else; it faces sideways."""
    for name, value in {"USUAL_TURN": 0, "LARGE_TURN": 0, "BLEND_PROBABILITY": 0, "HOP_PROBABILITY": 1}.items():
        monkeypatch.setattr(perturb, name, value)
    names, bind = ("Hips", "Hips/Spine"), np.tile(np.eye(4), (2, 1, 1))
    skeleton = Skeleton("/toy", names, np.array([-1, 0]), bind, bind)
    (motion,) = perturb_motions([Motion("/toy", 120.0, SIDEWAYS, np.zeros((480, 2, 3)))], skeleton, 1, 5, 1.0)
    return motion


def test_a_turn_begins_and_ends_at_rest_and_has_an_axis_of_the_world(tumbled):
    root = tumbled.rotations[:, 0]
    rate = angles(root[1:], root[:-1]) * 120
    assert (rate < 1e-3).mean() > 0.1 and np.abs(np.diff(rate)).max() < 1.5 < rate.max()
    assert np.array_equal(tumbled.rotations[:, 1], SIDEWAYS[:, 1])
    first = slice(np.flatnonzero(rate > 1e-3)[0], np.flatnonzero(rate > 1e-3)[0] + 30)
    turn = multiply_quaternions(root[first], SIDEWAYS[first, 0] * [1, -1, -1, -1])  # beside what was before
    axes = turn[5:, 1:] / np.linalg.norm(turn[5:, 1:], axis=-1, keepdims=True)
    np.testing.assert_allclose(axes, np.tile(axes[:1], (len(axes), 1)), atol=1e-6)


def test_a_hop_falls_freely_in_the_middle_of_a_turn(tumbled):
    height, turned = tumbled.translations[:, 0, 1], angles(tumbled.rotations[:, 0], SIDEWAYS[:, 0])
    fall = np.diff(height, 2) * 120**2
    flies, pushed = np.abs(fall + 9.81) < 1e-6, fall > 1e-6
    assert flies.sum() / 120 > 0.2 and fall.min() > -9.82 and 5 < fall.max() < 45 and pushed.sum() / 120 > 0.1
    top = height.argmax()
    assert turned[top] > np.radians(170) and height[top] > 0.5 * 9.81 * 0.2**2 - 0.03


def angles(p, q):
    """Return the angles between unit quaternions [rad]."""
    return 2 * np.arccos(np.abs((p * np.asarray(q)).sum(-1)).clip(max=1))


@pytest.mark.parametrize("half", [0.0, 0.5])
def test_a_frames_gradient_is_divided_by_its_stretch_and_collision(half):
    stretch, collision, gravity = (torch.tensor(v, requires_grad=True) for v in ([1.0, 3], [0.5, 90], [-2.0, 1]))
    latent = torch.tensor([2.0, 4.0], requires_grad=True)
    terms = {"stretch": stretch, "collision": collision, "gravity": gravity, REGULARIZATION: latent}
    total(terms, half).backward()
    share = [half / (half + 1.5), half / (half + 93)] if half else [1.0, 1.0]
    for value in (stretch, collision, gravity):
        np.testing.assert_allclose(value.grad, np.array(share) / 2, rtol=1e-6)
    assert latent.grad.tolist() == [0.5, 0.5]
