# SPDX-License-Identifier: Apache-2.0
"""Trajectories become joints and blendshapes: what is exact stays exact, and anything else meets its tolerance."""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
import pytest

from ssilk_core.errors import SsilkError
from ssilk_core.network.rollout import garment_poses
from ssilk_core.scene.assets import GarmentPose
from ssilk_core.scene.decomposition import FitTolerance, decompose
from ssilk_core.scene.decomposition.rest import rest_residuals
from ssilk_core.scene.decomposition.shapes import OffsetShapes, sparse_components
from ssilk_core.scene.kinematics import deform, lbs_deformer, local_transforms

FRAMES = 24


@pytest.fixture(scope="module")
def played(toy_scene, toy_model, toy_motion):
    scene = toy_scene()
    model, motion = toy_model(scene), toy_motion(scene, FRAMES)
    (pose,) = garment_poses(model, motion, 30.0)
    return model.deformer(), motion, pose


def distances(deformer, motion, poses, points) -> np.ndarray:
    return np.linalg.norm(np.concatenate([deform(deformer, motion, pose) for pose in poses]) - points, axis=-1)


def turned(pose: GarmentPose, size: float) -> GarmentPose:
    rotations = pose.rotations + size * np.random.default_rng(1).standard_normal(pose.rotations.shape)
    return GarmentPose(0, rotations / np.linalg.norm(rotations, axis=-1, keepdims=True), pose.weights)


def test_known_joints_and_shapes_are_recovered_without_further_shapes(played):
    deformer, motion, pose = played
    points = deform(deformer, motion, pose)
    found = decompose(deformer, motion, points, [turned(pose, 0.2)])
    assert distances(deformer, motion, [turned(pose, 0.2)], points).max() > 0.02
    assert found.own_shapes == 0 and found.deformer.shape_count == deformer.shape_count
    assert found.largest < 5e-4


def test_joints_alone_are_recovered_from_rest(played):
    deformer, motion, pose = played
    bones = replace(deformer, shapes=deformer.shapes[:0])
    few = motion.clip(0, 6)
    points = deform(bones, few, GarmentPose(0, pose.rotations[:6], np.zeros((6, 0))))
    found = decompose(bones, few, points)
    assert found.own_shapes == 0 and found.largest < 5e-4


def test_proxies_that_turn_and_move_are_recovered_from_rest_without_shapes(played):
    deformer, motion, pose = played
    bones, few, rng = replace(deformer, shapes=deformer.shapes[:0]), motion.clip(0, 6), np.random.default_rng(4)
    scene = deformer.scene
    rest = local_transforms(scene.bind_transforms, scene.parents)[scene.character.skeleton.joint_count :, :3, 3]
    moved = rest + rng.uniform(-0.05, 0.05, (6, *rest.shape))
    points = deform(bones, few, GarmentPose(0, pose.rotations[:6], np.zeros((6, 0)), moved))
    still = deform(bones, few, GarmentPose(0, pose.rotations[:6], np.zeros((6, 0))))
    assert np.linalg.norm(points - still, axis=-1).max() > 0.02
    found = decompose(bones, few, points)
    assert found.own_shapes == 0 and found.largest < 1e-3
    away = np.linalg.norm(GarmentPose.joined(found.poses).translations - moved, axis=-1)
    assert np.median(away) < 1e-3 and away.max() < 0.01  # a stiffness holds them near rest


@pytest.mark.parametrize("frames", [5, FRAMES])
def test_proxies_that_need_not_move_get_no_translations(played, frames):
    deformer, motion, pose = played
    bones, some = replace(deformer, shapes=deformer.shapes[:0]), motion.clip(0, frames)
    turning = GarmentPose(0, pose.rotations[:frames], np.zeros((frames, 0)))
    found = decompose(bones, some, deform(bones, some, turning), [turning])
    assert found.own_shapes == 0 and found.poses[0].translations is None


@pytest.mark.parametrize("rig", ["model", "joints", "no proxies"])
def test_anything_else_meets_its_tolerance(played, rig):
    deformer, motion, pose = played
    rng = np.random.default_rng(0)
    unknown = replace(deformer, shapes=np.concatenate([deformer.shapes, 0.02 * rng.standard_normal((3, 60, 3))]))
    waves = np.sin(np.outer(np.arange(FRAMES), [0.2, 0.5, 0.9]))
    points = deform(unknown, motion, GarmentPose(0, pose.rotations, np.concatenate([pose.weights, waves], axis=1)))
    points[7, 11] += 0.03  # one vertex in one frame
    points += 2e-4 * rng.standard_normal(points.shape)
    own = {
        "model": deformer,
        "joints": replace(deformer, shapes=deformer.shapes[:0]),
        "no proxies": lbs_deformer(deformer.scene),
    }[rig]
    found = decompose(own, motion, points, [pose] if rig == "model" else None)
    away = distances(found.deformer, motion, found.poses, points)
    assert np.sqrt((away**2).mean()) == pytest.approx(found.rms, rel=1e-6) and found.rms <= 1e-3
    assert away.max() == pytest.approx(found.largest, rel=1e-6) and found.largest <= 5e-3
    assert 3 <= found.own_shapes <= 22 and found.deformer.shape_count == own.shape_count + found.own_shapes
    weights = np.concatenate([each.weights for each in found.poses])
    assert weights.min() >= 0 and weights.max() <= 1 and weights.dtype == np.float32


def test_a_tighter_tolerance_needs_more_shapes(played):
    deformer, motion, pose = played
    points = deform(deformer, motion, pose) + 0.004 * np.random.default_rng(0).standard_normal((FRAMES, 60, 3))
    counts = [
        decompose(deformer, motion, points, [pose], tolerance=FitTolerance(rms, 10 * rms)).own_shapes
        for rms in (6e-3, 4e-3, 1e-5)
    ]
    assert counts[0] < counts[1] < counts[2] <= FRAMES + 1


def test_what_moves_few_vertices_becomes_a_local_shape():
    offsets = np.zeros((30, 400, 3), np.float32)
    offsets[10:14, 5:9, 1] = 0.02
    own = OffsetShapes(offsets, FitTolerance())
    own.find()
    shapes, weights = own.all_shapes()
    assert np.abs(np.einsum("fk,kvc->fvc", weights, shapes)[12, 6] - [0, 0.02, 0]).max() < 5e-3
    assert shapes.any(axis=-1).sum() <= 8 and not shapes[:, 20:].any()


def test_rounding_ends_the_search():
    """No component of noise this small counts, though its RMS exceeds the tolerance."""
    noise = 5e-7 * np.random.default_rng(0).standard_normal((512, 300, 3))
    own = OffsetShapes(noise.astype(np.float32), FitTolerance(2e-7, 1e-6))
    own.find()
    assert len(own.shapes) <= 1


def test_another_shape_that_stays_is_one_blendshape(played):
    deformer, motion, pose = played
    bones = replace(deformer, shapes=deformer.shapes[:0])
    held = replace(deformer, shapes=np.random.default_rng(0).uniform(0.01, 0.02, (1, 60, 3)))
    points = deform(held, motion, GarmentPose(0, pose.rotations, np.ones((FRAMES, 1))))
    found = decompose(bones, motion, points, [GarmentPose(0, pose.rotations, np.zeros((FRAMES, 0)))])
    assert found.own_shapes == 1 and found.largest < 1e-6 and found.poses[0].translations is None


def test_components_leave_out_the_vertices_to_which_they_matter_least():
    """Two halves that wave each in its own way need no vertex of the other half, and the RMS is used up."""
    rng = np.random.default_rng(0)
    sample, ways = np.zeros((80, 400, 3)), rng.standard_normal((80, 8))
    ways = np.sqrt(80) * np.linalg.qr(ways - ways.mean(axis=0))[0]
    for half, size, own in ((slice(0, 200), 0.02, ways[:, :4]), (slice(200, 400), 0.005, ways[:, 4:])):
        sample[:, half] = size * np.einsum("fk,kvc->fvc", own, rng.standard_normal((4, 200, 3)))
    found = sparse_components(sample, 1e-3, 80)
    moved = found.any(axis=-1)
    assert len(found) >= 8 and moved.sum() < 1.1 * 8 * 200
    flat = found.reshape(len(found), -1)
    weights = np.linalg.lstsq(flat.T, sample.reshape(80, -1).T, rcond=None)[0]
    left = sample - np.einsum("kf,kvc->fvc", weights, found)
    assert np.sqrt((left**2).sum(-1).mean()) <= 1e-3
    assert not len(sparse_components(np.zeros((4, 10, 3)), 1e-3, 4))


def test_offsets_in_the_rest_pose_give_the_vertices_back(played):
    deformer, motion, pose = played
    rng = np.random.default_rng(2)
    points = deform(deformer, motion, pose) + 0.05 * rng.standard_normal((FRAMES, 60, 3))
    offsets = np.concatenate([each for _, each in rest_residuals(deformer, motion, pose, points)])
    weights = np.concatenate([pose.weights, np.ones((FRAMES, 1))], axis=1)
    for frame in (0, 9, 23):
        shaped = replace(deformer, shapes=np.concatenate([deformer.shapes, offsets[frame][None]]))
        one = GarmentPose(frame, pose.rotations[frame : frame + 1], weights[frame : frame + 1])
        np.testing.assert_allclose(deform(shaped, motion, one)[0], points[frame], atol=2e-6)


def test_offsets_that_lie_in_a_file_become_the_same_shapes(played, monkeypatch):
    deformer, motion, pose = played
    points = deform(deformer, motion, pose) + 0.004 * np.random.default_rng(0).standard_normal((FRAMES, 60, 3))
    inside = decompose(deformer, motion, points, [pose])
    monkeypatch.setattr(sys.modules[decompose.__module__], "IN_MEMORY", 0)
    found = decompose(deformer, motion, points, [pose])
    np.testing.assert_array_equal(found.deformer.shapes, inside.deformer.shapes)


def test_many_frames_are_fitted_from_some_of_them(monkeypatch):
    rng = np.random.default_rng(0)
    offsets = (np.sin(np.outer(np.arange(96), [0.1, 0.3, 0.7])) @ rng.standard_normal((3, 180))).reshape(96, 60, 3)
    offsets[40:44] += rng.standard_normal((60, 3))  # which frames that are evenly spread do not tell of
    monkeypatch.setattr("ssilk_core.scene.decomposition.shapes.BASIS_FRAMES", 6)
    own = OffsetShapes((0.01 * offsets).astype(np.float32), FitTolerance())
    own.find()
    shapes, weights = own.all_shapes()
    away = np.linalg.norm(np.einsum("fk,kvc->fvc", weights, shapes) - 0.01 * offsets, axis=-1)
    assert np.sqrt((away**2).mean()) <= 1.001e-3 and away.max() <= 5.001e-3 and len(shapes) < 20


def test_points_of_another_garment_and_broken_ones_are_refused(played):
    deformer, motion, pose = played
    points = deform(deformer, motion, pose)
    with pytest.raises(SsilkError, match="24 frames for 23"):
        decompose(deformer, motion, points[1:])
    with pytest.raises(SsilkError, match=r"frame 0 has points of shape \(59, 3\)"):
        decompose(deformer, motion, points[:, 1:])
    points[3, 4] = np.nan
    with pytest.raises(SsilkError, match="frame 3 has NaN or infinity"):
        decompose(deformer, motion, points)


@pytest.mark.parametrize("frames", [1, 3])
def test_frames_that_are_all_the_same_need_one_constant_shape(frames):
    left = np.zeros((frames, 20, 3), np.float32)
    left[:, :10, 1] = 0.05
    found = OffsetShapes(left, FitTolerance())
    found.find()
    shapes, weights = found.all_shapes()
    assert shapes.shape == (1, 20, 3) and (weights == 1).all()
    np.testing.assert_allclose(shapes[0, :, 1], np.repeat([0.05, 0.0], 10), atol=1e-6)
