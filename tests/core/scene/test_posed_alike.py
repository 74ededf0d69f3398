# SPDX-License-Identifier: Apache-2.0
"""Characters with another skeleton, posed as a garment's own is bound, and what a network sees of them."""

from dataclasses import replace

import numpy as np
import pytest

from ssilk_core.errors import SsilkError
from ssilk_core.network.descriptors import inner_joints, pose_features
from ssilk_core.scene.assets import Body, Character, Mesh, SkinWeights
from ssilk_core.scene.kinematics import motion_transforms, skin_points, skinning_matrices
from ssilk_core.scene.posed_alike import alike, carrying, fitted_binds, posed_points, rotation_angles, unposed

from ..humanoids import PARTS, SCHEMES, humanoid, moved, moved_alike

OWN = humanoid(SCHEMES["cmu"], axes=1)
ALL = np.arange(len(PARTS))


@pytest.mark.parametrize(("arms", "turn"), [(45, 0), (0, 0), (0, 180), (70, 90)])
def test_a_figure_is_posed_as_another_is_bound(arms, turn):
    other = humanoid(SCHEMES["unreal"], arms=arms, turn=turn, axes=2)
    posed = alike(OWN, other, ALL)
    np.testing.assert_allclose(posed.transforms[:, :3, 3], OWN.bind_transforms[:, :3, 3], atol=1e-9)
    np.testing.assert_allclose(fitted_binds(OWN, posed, ALL), OWN.bind_transforms, atol=1e-9)
    limbs = [PARTS.index(f"{side} {part}") for side in ("left", "right") for part in ("upper arm", "forearm", "hand")]
    np.testing.assert_allclose(np.delete(posed.turned, limbs), 0, atol=1e-6)
    assert posed.turned[limbs].max() == pytest.approx(abs(arms - 45), abs=1.5)  # hands are a little bent forwards


def test_a_figure_that_is_bound_leaning_stands_upright():
    other = humanoid(SCHEMES["unreal"], arms=0, axes=2)
    lean = np.array([[1, 0, 0, 0], [0, 0.8, -0.6, 0], [0, 0.6, 0.8, 0], [0, 0, 0, 1.0]])
    leaning = replace(other, bind_transforms=lean @ other.bind_transforms)
    posed = alike(OWN, leaning, ALL)
    assert rotation_angles(posed.upright) == pytest.approx(36.87, abs=0.1)
    away = posed.transforms[:, :3, 3] - OWN.bind_transforms[:, :3, 3]
    np.testing.assert_allclose(away - away[0], 0, atol=1e-3)


def test_a_trunk_whose_joints_lie_elsewhere_is_not_bent():
    other = humanoid(SCHEMES["unreal"], axes=2)
    binds = np.array(other.bind_transforms)
    binds[[1, 2, 3], 2, 3] += [0.04, -0.03, 0.03]
    posed = alike(OWN, replace(other, bind_transforms=binds), ALL)
    np.testing.assert_allclose(posed.turned[:6], 0, atol=1e-9)


def test_a_limb_that_is_bound_the_other_way_is_refused():
    other = humanoid(SCHEMES["unreal"], arms=-110)
    with pytest.raises(SsilkError, match=r"'upperarm_l' is bound 1\d\d degrees from where .* A-pose or a T-pose"):
        alike(OWN, other, ALL)


def clothed(skeleton):
    """The figure with a body of points around its joints, each on two of these."""
    dice = np.random.default_rng(4)
    joints = np.repeat(np.arange(skeleton.joint_count), 6)
    points = skeleton.bind_transforms[joints, :3, 3] + dice.normal(0, 0.05, (len(joints), 3))
    faces = np.arange(len(joints)).reshape(-1, 3)
    above = np.maximum(skeleton.parents[joints], 0)
    skin = SkinWeights("/body", np.stack([joints, above], axis=1), np.tile([0.7, 0.3], (len(joints), 1)))
    return Character("/figure", skeleton, (Body(Mesh("/body", points, faces), skin),))


@pytest.mark.parametrize("scheme", ["unreal", "numbers"])
@pytest.mark.parametrize(("arms", "turn"), [(45, 0), (0, 0), (0, 180)])
def test_a_network_sees_the_joints_that_it_was_trained_on(scheme, arms, turn):
    other = humanoid(SCHEMES[scheme], arms=arms, turn=turn, axes=5)
    posed = alike(OWN, other, ALL)
    character = carrying(OWN, clothed(other), ALL, posed)
    motion = moved(OWN, 20)
    theirs = moved_alike(motion, OWN, other, posed.transforms, ALL)
    joints = np.arange(OWN.joint_count)
    np.testing.assert_array_equal(inner_joints(character.skeleton, joints), inner_joints(OWN, joints))
    for kind in ("relative", "absolute"):
        own, seen = (
            pose_features(motion, OWN, joints, kind=kind),
            pose_features(theirs, character.skeleton, joints, kind=kind),
        )
        for name in ("static", "dynamic", "down", "earlier"):
            np.testing.assert_allclose(getattr(seen, name), getattr(own, name), atol=1e-7)


@pytest.mark.parametrize(("arms", "turn"), [(0, 0), (45, 180), (0, 90)])
def test_a_bind_pose_that_is_turned_moves_joints_and_skin_as_before(arms, turn):
    other = humanoid(SCHEMES["unreal"], arms=arms, turn=turn, axes=5)
    before = clothed(other)
    after = carrying(OWN, before, ALL, alike(OWN, other, ALL))
    motion = moved(other, 5)
    points = []
    for character in (before, after):
        world = motion_transforms(motion, character.skeleton.parents)
        matrices = skinning_matrices(world, character.skeleton.bind_transforms)
        body = character.merged_body()
        points.append(skin_points(body.mesh.points, body.skin, matrices))
    np.testing.assert_allclose(points[1], points[0], atol=1e-9)
    # The trunk is bound as the own one stands.
    hub = after.skeleton.bind_transforms[:6, :3, 3]
    np.testing.assert_allclose(
        hub - hub[0], (OWN.bind_transforms[:6, :3, 3] - OWN.bind_transforms[0, :3, 3]), atol=1e-9
    )


def test_points_are_brought_into_the_bind_pose_and_back():
    other = humanoid(SCHEMES["unreal"], arms=0, axes=5)
    posed, body = alike(OWN, other, ALL), clothed(other).merged_body()
    points = body.mesh.points + 0.01
    back = posed_points(unposed(points, body.skin, posed, other), body.skin, posed, other)
    np.testing.assert_allclose(back, points, atol=1e-9)
