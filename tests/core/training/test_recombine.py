# SPDX-License-Identifier: Apache-2.0
"""Motions made of the limbs of one clip and the body of another."""

import numpy as np
import pytest

from ssilk_core.scene.assets import Motion, Skeleton
from ssilk_core.scene.kinematics import motion_transforms
from ssilk_core.training.recombine import limb_joints, recombine_motions, replace_limbs

NAMES = ("Hips", "Hips/Leg", "Hips/Leg/Foot", "Hips/Spine", "Hips/Spine/Arm", "Hips/Spine/Head")


@pytest.fixture
def skeleton() -> Skeleton:
    bind = np.tile(np.eye(4), (6, 1, 1))
    bind[:, 1, 3] = np.arange(6)
    return Skeleton("/toy", NAMES, np.array([-1, 0, 1, 0, 3, 3]), bind, bind)


def motion(path: str, frames: int, fps: float = 30.0) -> Motion:
    """A motion in which every joint of every frame turns by its own angle about x."""
    angle = 0.1 * np.arange(frames)[:, None] + 0.01 * np.arange(6) + (1.0 if path == "/b" else 0.0)
    rotations = np.stack([np.cos(angle / 2), np.sin(angle / 2), 0 * angle, 0 * angle], axis=-1)
    return Motion(path, fps, rotations, np.ones((frames, 6, 3)))


def test_limbs_are_what_hangs_below_joints_that_have_siblings(skeleton):
    assert [limb.tolist() for limb in limb_joints(skeleton)] == [[1, 2], [3, 4, 5], [4], [5]]


def test_limbs_turn_as_in_the_donor_to_and_fro_and_all_else_as_before(skeleton):
    base, donor = motion("/a", 9), motion("/b", 4)
    found = replace_limbs(base, donor, np.array([1, 2]), 2)
    np.testing.assert_allclose(found.rotations[:, [1, 2]], donor.rotations[[2, 3, 2, 1, 0, 1, 2, 3, 2]][:, [1, 2]])
    np.testing.assert_array_equal(found.rotations[:, [0, 3, 4, 5]], base.rotations[:, [0, 3, 4, 5]])
    np.testing.assert_array_equal(found.translations, base.translations)
    world = [motion_transforms(m, skeleton.parents)[:, 5] for m in (found, base)]
    np.testing.assert_allclose(*world)  # the head does not know of the legs


def test_a_donor_at_another_rate_moves_limbs_at_its_own_speed():
    found = replace_limbs(motion("/a", 4), motion("/b", 9, fps=60.0), np.array([4]), 0)
    np.testing.assert_allclose(found.rotations[:, 4], motion("/b", 9).rotations[[0, 2, 4, 6]][:, 4], atol=1e-12)


def test_every_motion_is_recombined_with_others_alone_and_alike_for_a_seed(skeleton):
    motions = [motion("/a", 9), motion("/b", 5), motion("/c", 7)]
    found, again = (recombine_motions(motions, skeleton, 20, 3) for _ in range(2))
    assert 30 < len(found) <= 60
    for one, other in zip(found, again):
        np.testing.assert_array_equal(one.rotations, other.rotations)
    for item in found:
        base, donor = item.path.split(" with limbs of ")
        assert base != donor
        source = next(m for m in motions if m.path == base)
        assert not np.array_equal(item.rotations, source.rotations)
        np.testing.assert_array_equal(item.rotations[:, 0], source.rotations[:, 0])
    assert recombine_motions(motions, skeleton, 0, 3) == [] and recombine_motions(motions[:1], skeleton, 5, 3) == []
