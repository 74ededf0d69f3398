# SPDX-License-Identifier: Apache-2.0
"""Motions turned at random or nearer to the bind pose, and the loss in which poses without a good state count less."""

import numpy as np
import pytest
import torch

from ssilk_core.kinematics import local_transforms, quaternion_from_matrix
from ssilk_core.training.objective import REGULARIZATION, total
from ssilk_core.training.perturb import perturb_motions


def test_every_joint_but_the_root_turns_and_alike_for_a_seed(scene, toy_motion):
    motions, skeleton = [toy_motion(scene, 40), toy_motion(scene, 25, speed=2.0)], scene.character.skeleton
    found, again = (perturb_motions(motions, skeleton, 2, 3) for _ in range(2))
    assert len(found) == 4 and perturb_motions(motions, skeleton, 0, 3) == []
    for motion, other, base in zip(found, again, motions * 2, strict=True):
        np.testing.assert_array_equal(motion.rotations, other.rotations)
        np.testing.assert_allclose(np.linalg.norm(motion.rotations, axis=-1), 1)
        np.testing.assert_allclose(motion.rotations[:, 0], base.rotations[:, 0], atol=1e-12)
        assert np.array_equal(motion.translations, base.translations)
        turn = angles(motion.rotations, base.rotations)[:, 1:]
        assert (turn.mean(axis=0) > 0.02).all() and np.abs(np.diff(turn, axis=0)).max() < 0.5
    assert not np.array_equal(found[0].rotations, found[2].rotations)


def test_about_half_of_the_motions_go_to_and_fro_between_their_poses_and_the_bind_pose(scene, toy_motion):
    skeleton = scene.character.skeleton
    bind = quaternion_from_matrix(local_transforms(skeleton.bind_transforms, skeleton.parents)[:, :3, :3])
    found = perturb_motions([toy_motion(scene, 400)], skeleton, 60, 1)
    near = np.array([angles(m.rotations, bind)[:, 1:].max(axis=1).min() for m in found])
    assert 20 <= (near < 0.01).sum() <= 40  # there, all joints reach it in one frame
    blended = found[near.argmin()]
    assert np.median(angles(blended.rotations, bind)[:, 1:].max(axis=1)) > 0.1
    assert np.abs(np.diff(angles(blended.rotations, bind), axis=0)).max() < 0.2


def angles(p, q):
    """Return the angles between unit quaternions [rad]."""
    return 2 * np.arccos(np.abs((p * q).sum(-1)).clip(max=1))


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
