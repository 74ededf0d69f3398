# SPDX-License-Identifier: Apache-2.0
"""Least squares onto joints and blendshapes: poses are found again, the Jacobian is that of differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssilk_core.errors import SsilkError
from ssilk_core.network.rollout import garment_poses
from ssilk_core.scene.assets import GarmentPose
from ssilk_core.scene.decomposition.poses import PoseFitter, _Search
from ssilk_core.scene.kinematics import deform, local_transforms

FRAMES = 5


@pytest.fixture(scope="module", params=[False, True], ids=["chain", "both from the character"])
def played(request, toy_scene, toy_model, toy_motion):
    scene = toy_scene(shuffled=request.param)
    # Small steps keep weights away from their ends.
    model = toy_model(scene, max_latent_step=0.3, velocity_allowance=0.5)
    motion = toy_motion(scene, FRAMES)
    (pose,) = garment_poses(model, motion, 30.0)
    return model.deformer(), motion, pose


@pytest.fixture
def mass(scene):
    return np.linspace(1, 2, scene.garment.mesh.vertex_count)


def disturbed(pose: GarmentPose, size: float, seed: int = 0) -> GarmentPose:
    rng = np.random.default_rng(seed)
    rotations = pose.rotations + size * rng.standard_normal(pose.rotations.shape)
    weights = pose.weights.copy()
    weights[:, :-1] = (weights[:, :-1] + size * rng.standard_normal(weights[:, :-1].shape)).clip(0, 1)
    return GarmentPose(pose.start, rotations / np.linalg.norm(rotations, axis=-1, keepdims=True), weights)


def test_vertices_of_a_pose_are_found_again(played, mass):
    deformer, motion, pose = played
    wanted = deform(deformer, motion, pose)
    start = disturbed(pose, 0.2)
    (fit,) = PoseFitter(deformer, mass).fit(motion, [start], wanted)
    found = deform(deformer, motion, fit.pose)
    before = np.linalg.norm(deform(deformer, motion, start) - wanted, axis=-1)
    after = np.linalg.norm(found - wanted, axis=-1)
    assert before.max() > 0.02 and after.max() < 2e-4
    np.testing.assert_allclose(fit.largest, after.max(axis=1), atol=1e-6)
    np.testing.assert_allclose(fit.rms, np.sqrt(after**2 @ mass / mass.sum()), atol=1e-6)


def moving(deformer, pose: GarmentPose, size: float) -> GarmentPose:
    """The pose with proxies that are up to `size` [m] from their places along each axis."""
    scene, away = deformer.scene, np.random.default_rng(5).uniform(-size, size, (*pose.rotations.shape[:2], 3))
    rest = local_transforms(scene.bind_transforms, scene.parents)[scene.character.skeleton.joint_count :, :3, 3]
    return replace(pose, translations=rest + away)


@pytest.mark.parametrize("moves", [False, True])
def test_the_jacobian_is_that_of_differences(played, mass, moves):
    deformer, motion, pose = played
    fitter = PoseFitter(deformer, mass)
    wanted = fitter._tensor(deform(deformer, motion, pose)[:, fitter.free])
    start = disturbed(pose, 0.05)
    search = _Search(fitter, motion, moving(deformer, start, 0.05) if moves else start, wanted)
    jacobian, base = search._jacobian().numpy(), search.posed.away.numpy()
    assert jacobian.shape[-1] == len(fitter.moving) + (6 if moves else 3) * fitter.proxies
    for column in range(jacobian.shape[-1]):
        step = np.zeros((FRAMES, jacobian.shape[-1]))
        step[:, column] = 1e-3
        trial = search._stepped(fitter._tensor(step))
        used = np.where(trial.weights != search.pose.weights, 1, 0).sum(1) if column < 4 else np.ones(FRAMES)
        moved = (base - search._at(trial).away.numpy()) / 1e-3
        expected = jacobian[..., column] * used[:, None, None]  # a weight at its end cannot move
        np.testing.assert_allclose(moved, expected, atol=2e-3)


def test_no_frame_ends_further_off_and_weights_stay_in_their_range(played, mass):
    deformer, motion, pose = played
    rng = np.random.default_rng(3)
    out_of_reach = deform(deformer, motion, pose) + 0.03 * rng.standard_normal((FRAMES, len(mass), 3))
    out_of_reach[:, deformer.scene.classes == 0] = deform(deformer, motion, pose)[:, deformer.scene.classes == 0]
    (fit,) = PoseFitter(deformer, mass).fit(motion, [pose], out_of_reach)
    away = np.linalg.norm(deform(deformer, motion, pose) - out_of_reach, axis=-1)
    assert (fit.rms < np.sqrt(away**2 @ mass / mass.sum())).all()
    assert fit.pose.weights.min() >= 0 and fit.pose.weights.max() <= 1 and (fit.pose.weights[:, -1] == 1).all()
    # No small change of any rotation or weight brings it nearer.
    fitter = PoseFitter(deformer, mass)
    search = _Search(fitter, motion, fit.pose, fitter._tensor(out_of_reach[:, fitter.free]))
    for column in range(search._jacobian().shape[-1]):
        for sign in (-1, 1):
            step = np.zeros((FRAMES, search._jacobian().shape[-1]))
            step[:, column] = sign * 0.02
            assert (search._at(search._stepped(fitter._tensor(step))).error > search.posed.error * 0.999).all()


def test_a_character_far_away_is_fitted_as_well(played, mass):
    deformer, motion, pose = played
    moved = motion.translations.copy()
    moved[:, 0] += [3000.0, 0, -2000.0]
    far = replace(motion, translations=moved)
    (near,) = PoseFitter(deformer, mass).fit(motion, [disturbed(pose, 0.1)], deform(deformer, motion, pose))
    (away,) = PoseFitter(deformer, mass).fit(far, [disturbed(pose, 0.1)], deform(deformer, far, pose))
    np.testing.assert_allclose(away.rms, near.rms, atol=1e-6)


def test_vertices_that_are_not_finite_are_refused(played, mass):
    deformer, motion, pose = played
    wanted = deform(deformer, motion, pose)
    wanted[2, 1] = np.nan
    with pytest.raises(SsilkError, match="frames 0 to 4: NaN or infinity among the vertices"):
        next(PoseFitter(deformer, mass).fit(motion, [pose], wanted))
