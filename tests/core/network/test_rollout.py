# SPDX-License-Identifier: Apache-2.0
"""Rollouts: chunks, rates, cuts, very short and very long motions."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation, Slerp

from ssilk_core.errors import SsilkError
from ssilk_core.network.descriptors import pose_features
from ssilk_core.network.model.descriptors import gravity_features
from ssilk_core.network.model.feedback import BodyFrames
from ssilk_core.network.rollout import decode, garment_poses, resample_poses, roll
from ssilk_core.scene.assets import GarmentPose, Motion
from ssilk_core.scene.kinematics import deform, motion_transforms, resample, run_up


@pytest.fixture(scope="module")
def model(scene, toy_model):
    # Weak enough not to be chaotic, so that rounding in another order stays rounding.
    return toy_model(scene, scale=0.1).eval()


def joined(steps) -> tuple[torch.Tensor, torch.Tensor]:
    steps = list(steps)
    starts = np.cumsum([0] + [step.activation.shape[-1] for step in steps])
    assert [step.start for step in steps] == starts[:-1].tolist()
    return torch.cat([s.activation for s in steps], -1), torch.cat([s.transforms for s in steps], -1)


def gathered(poses) -> GarmentPose:
    poses = list(poses)
    starts = np.cumsum([0] + [pose.frame_count for pose in poses])
    assert [pose.start for pose in poses] == starts[:-1].tolist() and all(pose.frame_count for pose in poses)
    return GarmentPose.joined(poses)


@torch.no_grad()
def plain_loop(model, motion: Motion) -> list[torch.Tensor]:
    """States of a motion without cuts, one frame at a time over the descriptors of the whole motion."""
    features = pose_features(motion, model.scene.character.skeleton, model.joints)
    world = motion_transforms(motion, model.scene.character.skeleton.parents)
    body = BodyFrames.of(world, model.scene.character.skeleton, next(model.parameters()))
    count = motion.frame_count
    down = torch.tensor([0.0, -1, 0]).expand(count, 3)
    static, dynamic, turned = (
        torch.tensor(v, dtype=torch.float32) for v in (features.static, features.dynamic, features.down)
    )
    static = torch.cat([static, gravity_features(turned, down)], dim=1)
    z = []
    for t in range(count):
        rest = model.initial(static[t : t + 1])
        seen = torch.cat([static[t : t + 1], dynamic[t : t + 1]], dim=1)
        if t < 2:
            z.append(rest)
            continue
        z.append(model.step(z[-2], z[-1], rest, seen, model.seen_from(z[-2], z[-1], body[t - 2 : t + 1])))
    return z


def test_a_rollout_is_the_plain_recurrence(model, scene, toy_motion):
    motion = toy_motion(scene, 50)
    expected = model.pose(torch.cat(plain_loop(model, motion)))
    for mine, theirs in zip(joined(roll(model, motion)), expected):
        np.testing.assert_allclose(mine, theirs.detach(), atol=1e-4)  # rounding, which velocities amplify
    assert expected[0].diff(dim=1).abs().max() > 0.01  # it moves


@pytest.mark.parametrize(("seconds", "count"), [(1.0, 30), (0.01, 1)])
def test_a_pre_roll_is_a_rollout_that_began_earlier(model, scene, toy_motion, seconds, count):
    motion = toy_motion(scene, 50)
    before = run_up(motion, seconds)
    rotations, translations = (
        np.concatenate([getattr(part, name) for part in (before, motion)]) for name in ("rotations", "translations")
    )
    longer = Motion(motion.path, motion.fps, rotations, translations)
    assert before.frame_count == count
    for mine, whole in zip(joined(roll(model, motion, 16, pre_roll=seconds)), joined(roll(model, longer))):
        np.testing.assert_allclose(mine, whole[..., count:], atol=1e-4)
    stored = gathered(garment_poses(model, motion, 24.0, pre_roll=seconds))
    assert stored.frame_count == gathered(garment_poses(model, motion, 24.0)).frame_count


@pytest.mark.parametrize("chunk", [1, 2, 3, 7, 49, 50, 1000])
def test_chunks_change_nothing(model, scene, toy_motion, chunk):
    motion = toy_motion(scene, 50)
    for mine, theirs in zip(joined(roll(model, motion, chunk)), joined(roll(model, motion))):
        np.testing.assert_allclose(mine, theirs, atol=1e-4)


@pytest.mark.parametrize("frames", [1, 2, 3])
@pytest.mark.parametrize("fps", [24.0, 30.0, 60.0])
def test_the_shortest_motions_work(model, scene, toy_motion, frames, fps):
    pose = gathered(garment_poses(model, toy_motion(scene, frames, fps), fps))
    assert pose.frame_count == frames and np.isfinite(pose.rotations).all()


@pytest.mark.parametrize("frames", [2, 3, 140, 141])
@pytest.mark.parametrize(
    "source, target", [(60, 60), (24, 24), (30, 30), (60, 30), (24, 30), (30, 24), (25, 60), (59.94, 59.94)]
)
def test_poses_cover_exactly_the_frames_of_the_motion(model, scene, toy_motion, frames, source, target):
    motion = toy_motion(scene, frames, source)
    pose = gathered(garment_poses(model, motion, target, 10))
    assert pose.frame_count == resample(motion, target).frame_count
    if source == target:
        assert pose.frame_count == frames


@pytest.mark.parametrize("chunk", [2, 5, 64])
@pytest.mark.parametrize("target", [24.0, 60.0, 59.94])
def test_resampled_poses_lie_on_the_arcs_between_steps(chunk, target):
    rng = np.random.default_rng(0)
    rotations = Rotation.from_rotvec(np.cumsum(0.1 * rng.normal(size=(20, 3)), axis=0))
    quaternions, weights = np.roll(rotations.as_quat(), 1, axis=1)[:, None], rng.random((20, 2))
    whole = GarmentPose(0, quaternions, weights, rng.normal(size=(20, 1, 3)))
    pieces = (whole.part(slice(s, s + chunk)) for s in range(0, 20, chunk))
    count = int(19 / 30 * target + 1e-6) + 1
    found = gathered(resample_poses(pieces, 30.0, target, count=count))
    assert found.frame_count == count
    time = (np.arange(count) / target).clip(max=19 / 30)
    expected = Slerp(np.arange(20) / 30, rotations)(time).as_matrix()
    turned = Rotation.from_quat(np.roll(found.rotations[:, 0], -1, axis=1)).as_matrix()
    np.testing.assert_allclose(turned, expected, atol=1e-9)
    for shape in range(2):
        np.testing.assert_allclose(
            found.weights[:, shape], np.interp(time, np.arange(20) / 30, weights[:, shape]), atol=1e-6
        )
    for axis in range(3):
        between = np.interp(time, np.arange(20) / 30, whole.translations[:, 0, axis])
        np.testing.assert_allclose(found.translations[:, 0, axis], between, atol=1e-9)


def test_after_a_cut_the_garment_starts_from_the_initialiser(model, scene, toy_motion):
    motion = toy_motion(scene, 40)
    jumped = motion.translations.copy()
    jumped[17:, 0] += [0, 0, 50]
    cut = replace(motion, translations=jumped)
    found = gathered(garment_poses(model, cut, motion.fps, chunk=8))
    for span, part in ((slice(0, 17), motion.clip(0, 17)), (slice(17, 40), motion.clip(17, 40))):
        alone = gathered(garment_poses(model, part, motion.fps))
        np.testing.assert_allclose(found.weights[span], alone.weights, atol=2e-5)
        np.testing.assert_allclose(found.rotations[span], alone.rotations, atol=2e-5)
    uncut = gathered(garment_poses(model, motion, motion.fps))
    assert np.abs(found.weights - uncut.weights)[17:].max() > 1e-3


@pytest.mark.parametrize("fps", [24.0, 30.0, 60.0])
def test_nothing_is_interpolated_across_a_cut(model, scene, toy_motion, fps):
    motion = toy_motion(scene, 40, 48.0)
    jumped = motion.translations.copy()
    jumped[17:, 0] += [0, 0, 50]
    found = gathered(garment_poses(model, replace(motion, translations=jumped), fps))
    assert found.frame_count == int(39 / 48 * fps + 1e-6) + 1
    before = int(16 / 48 * fps + 1e-6) + 1
    alone = gathered(garment_poses(model, motion.clip(0, 17), fps))
    np.testing.assert_allclose(found.weights[:before], alone.weights, atol=2e-5)


def test_a_motion_of_another_rate_is_refused(model, scene, toy_motion):
    with pytest.raises(SsilkError, match="24 frames per second; the model steps at 30"):
        list(roll(model, toy_motion(scene, 5, 24.0)))


@pytest.mark.parametrize("start, count", [(0, 12), (5, 4)])
def test_decoded_vertices_are_what_a_file_reader_deforms_even_far_away(model, scene, toy_motion, start, count):
    motion = toy_motion(scene, 12)
    motion = replace(
        motion,
        translations=motion.translations + np.array([[[3000.0, 40, -7000]], *[[[0.0] * 3]] * 2]).transpose(1, 0, 2),
    )
    pose = gathered(garment_poses(model, motion, 30.0))
    part = GarmentPose(start, pose.rotations[start : start + count], pose.weights[start : start + count])
    found = decode(model, motion, part)
    assert found.shape == (count, 60, 3)
    np.testing.assert_allclose(found, deform(model.deformer(), motion, part), atol=1e-5)


def test_a_thousand_frames_of_a_loop_stay_where_they_are(model, scene, toy_motion, monkeypatch):
    """With random weights, whose steps lead out of the bound of latents: none is learned, all are built in."""
    loop = toy_motion(scene, 200)
    times = 5
    motion = Motion("/loop", 30.0, np.tile(loop.rotations, (times, 1, 1)), np.tile(loop.translations, (times, 1, 1)))
    model = type(model)(scene, model.config, model.joints, 5)
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for value in model.parameters():
            value.add_(0.5 * torch.randn(value.shape, generator=generator))
        model.integrator.share.fill_(-9)  # springs hardly pull
    farthest = {"advance": [], "step": []}
    for name, found in farthest.items():
        own = getattr(model.integrator, name)

        def recorded(*given, own=own, found=found):
            z = own(*given)
            found.append(float(z.abs().max()))
            return z

        monkeypatch.setattr(model.integrator, name, recorded)
    extent, weights = [], []
    for pose in garment_poses(model, motion, 30.0):
        vertices = decode(model, motion, pose)
        extent.append(np.abs(vertices).max(axis=(1, 2)))
        weights.append((pose.weights.min(), pose.weights.max()))
    extent = np.concatenate(extent)
    assert extent.shape == (1_000,) and np.isfinite(extent).all()
    first, last = extent[:200].max(), extent[-200:].max()
    assert last < 1.5 * first
    assert np.min(weights) >= 0 and np.max(weights) <= 1
    assert max(farthest["advance"]) > model.config.latent_bound >= max(farthest["step"])
