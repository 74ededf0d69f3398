# SPDX-License-Identifier: Apache-2.0
"""The bank of motions, and the windows drawn from it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ssilk_core.errors import SsilkError
from ssilk_core.network.descriptors import pose_features
from ssilk_core.network.settings import STRONGEST_PULL
from ssilk_core.scene.kinematics import motion_transforms, skinning_matrices
from ssilk_core.training.motion_bank import MotionBank, build_bank
from ssilk_core.training.settings import TrainConfig
from ssilk_core.training.windows import WindowSampler, random_directions, random_pulls

CPU, JOINTS = torch.device("cpu"), np.arange(3)
CONFIG = TrainConfig(batch=6, window=5, state_reuse=0.7)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.fixture(scope="module")
def motions(scene, toy_motion):
    return [toy_motion(scene, 7), toy_motion(scene, 23, speed=2.0), toy_motion(scene, 12)]


@pytest.fixture(scope="module")
def bank(scene, motions) -> MotionBank:
    return build_bank(motions, scene.character.skeleton, JOINTS, 30.0, CPU)


def test_clips_stand_one_after_the_other(scene, bank, motions):
    assert bank.starts.tolist() == [0, 7, 30] and bank.stops.tolist() == [7, 30, 42]
    features = pose_features(motions[1], scene.character.skeleton, JOINTS)
    np.testing.assert_allclose(bank.static[7:30], features.static, atol=1e-6)
    np.testing.assert_allclose(bank.dynamic[7:30], features.dynamic, atol=1e-6)
    frames = torch.tensor([3, 11])
    down = torch.tensor([[0.0, -1, 0], [1.0, 0, 0]])
    both = bank.dynamic_descriptor(frames, down)
    np.testing.assert_allclose(both[:, : 12 + 9], bank.static_descriptor(frames, down))
    np.testing.assert_allclose(both[1, 12:21], bank.down[11, :, :, 0].reshape(-1), atol=1e-6)


def test_each_clip_is_moved_to_start_at_the_origin(scene, bank, motions):
    skeleton = scene.character.skeleton
    far = replace(motions[1], translations=motions[1].translations + [[500.0, 0, 800]] * np.array([[1], [0], [0]]))
    moved = build_bank([far], skeleton, JOINTS, 30.0, CPU)
    np.testing.assert_allclose(moved.matrices, bank.matrices[7:30], atol=1e-5)
    world = motion_transforms(motions[1], skeleton.parents)
    expected = skinning_matrices(world, skeleton.bind_transforms)
    expected[..., :3, 3] -= world[0, 0, :3, 3]
    frames = torch.arange(7, 30)
    np.testing.assert_allclose(bank.character(frames).permute(3, 0, 1, 2), expected[:, :, :3], atol=1e-5)
    np.testing.assert_allclose(bank.root[7:30], world[:, 0, :3, 3] - world[0, 0, :3, 3], atol=1e-5)


def test_motions_of_another_rate_are_resampled_and_cuts_split(scene, toy_motion):
    skeleton = scene.character.skeleton
    fast = toy_motion(scene, 41, fps=60.0)
    assert build_bank([fast], skeleton, JOINTS, 30.0, CPU).frame_count == 21
    jumped = fast.translations.copy()
    jumped[20:, 0] += [10, 0, 0]
    jumped[39:, 0] += [0, 0, 30]
    cut = build_bank([replace(fast, translations=jumped)], skeleton, JOINTS, 30.0, CPU)
    assert cut.stops.tolist() == [10, 20]  # 20 frames, then 19; the last two are too few to learn from


@pytest.mark.parametrize(
    "frames, fps, words",
    [(None, 30.0, "none given"), (3, 30.0, "shorter than four frames"), (1, 8.0, "shorter than four frames")],
)
def test_too_little_motion_is_refused(scene, toy_motion, frames, fps, words):
    motions = [] if frames is None else [toy_motion(scene, frames, fps)]
    with pytest.raises(SsilkError, match=words):
        build_bank(motions, scene.character.skeleton, JOINTS, 30.0, CPU)


def test_windows_stay_within_their_clip_and_carry_what_they_say(bank):
    sampler = WindowSampler(bank, CONFIG, 3, generator())
    seen = set()
    for step in range(300):
        before = {name: value.clone() for name, value in sampler.state().items()}
        latents = torch.full((2, 6, 3), float(step))
        sampler.advance(latents)
        assert torch.equal(sampler.latents, latents)
        clip = torch.searchsorted(bank.stops, sampler.first, right=True)
        assert (sampler.first >= bank.starts[clip]).all() and (sampler.first + 5 <= bank.stops[clip]).all()
        kept = sampler.carried
        assert torch.equal(sampler.first[kept], before["first"][kept] + 3)
        assert torch.equal(sampler.direction[kept], before["direction"][kept])
        np.testing.assert_allclose(sampler.direction.norm(dim=1), 1, atol=1e-6)
        seen |= set(sampler.first.tolist())
    every = {f for a, b in zip(bank.starts, bank.stops) for f in range(int(a), int(b) - 4)}
    assert seen == every


def test_a_slot_at_the_end_of_its_clip_starts_anew(bank):
    sampler = WindowSampler(bank, replace(CONFIG, state_reuse=1.0), 3, generator())
    last = sampler.first + 3 + 5 > sampler.stop_of[sampler.first]
    sampler.advance(torch.zeros(2, 6, 3))
    assert torch.equal(sampler.carried, ~last) and last.any() and not last.all()


@pytest.mark.parametrize("carry, expected", [(0.0, 0.0), (0.5, 0.5), (1.0, 1.0)])
def test_the_share_that_is_carried(scene, toy_motion, carry, expected):
    long = build_bank([toy_motion(scene, 4000)], scene.character.skeleton, JOINTS, 30.0, CPU)
    sampler = WindowSampler(long, replace(CONFIG, batch=2000, state_reuse=carry), 3, generator())
    sampler.advance(torch.zeros(2, 2000, 3))
    assert sampler.carried.double().mean().item() == pytest.approx(expected, abs=0.04)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_the_share_that_is_rotated_points_anywhere(share):
    directions = random_directions(20_000, share, generator(), CPU).double()
    down = (directions == torch.tensor([0.0, -1, 0])).all(dim=1)
    assert 1 - down.double().mean().item() == pytest.approx(share, abs=0.02)
    np.testing.assert_allclose(directions.norm(dim=1), 1, atol=1e-6)
    if share == 1.0:  # uniform on the sphere: no mean, and a third of the square along each axis
        np.testing.assert_allclose(directions.mean(0), 0, atol=0.02)
        np.testing.assert_allclose(directions.T @ directions / 20_000, np.eye(3) / 3, atol=0.01)


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_the_share_that_is_in_wind_is_pulled_anywhere_up_to_the_strongest(share):
    pulls = random_pulls(20_000, share, generator(), CPU).double()
    sizes = pulls.norm(dim=1)
    assert (sizes > 0).double().mean().item() == pytest.approx(share, abs=0.02)
    if share:
        blown = pulls[sizes > 0] / sizes[sizes > 0, None]
        np.testing.assert_allclose(blown.mean(0), 0, atol=0.02)
        assert sizes.max().item() == pytest.approx(STRONGEST_PULL, rel=0.01)
        assert sizes[sizes > 0].mean().item() == pytest.approx(STRONGEST_PULL / 2, rel=0.03)


def test_wind_goes_on_from_window_to_window_and_changes_evenly_within_one(scene, toy_motion):
    long = build_bank([toy_motion(scene, 4000)], scene.character.skeleton, JOINTS, 30.0, CPU)
    config = replace(CONFIG, batch=400, state_reuse=0.9, wind_fraction=0.5)
    sampler, changed = WindowSampler(long, config, 3, generator()), 0.0
    assert torch.equal(sampler.pull[0], sampler.pull[1])  # the first windows start at rest, in a steady wind
    for _ in range(20):
        before = sampler.gravity()
        np.testing.assert_allclose(before.diff(n=2, dim=0), 0, atol=1e-5)
        sampler.advance(torch.zeros(2, 400, 3))
        now, kept = sampler.gravity(), sampler.carried
        np.testing.assert_allclose(now[0, kept], before[-2, kept], atol=1e-5)
        assert torch.equal(sampler.pull[0][~kept], sampler.pull[1][~kept])
        changed += (sampler.pull[0] != sampler.pull[1]).any(1).double().mean().item() / 20
    assert 0.05 < changed < 0.4
    poses = sampler.poses(4000)[1]
    straight = (poses == torch.tensor([0.0, -1, 0])).all(dim=1).double().mean().item()
    assert straight == pytest.approx(0.5 * (1 - config.rotated_fraction), abs=0.03)


@pytest.mark.parametrize("correlation", [0.0, 0.99])
def test_noise_has_its_size_and_correlation(bank, correlation):
    config = replace(CONFIG, batch=5000, noise=0.2, noise_correlation=correlation)
    first, second = WindowSampler(bank, config, 4, generator()).noise().flatten(1).double()
    assert first.std().item() == pytest.approx(0.2, rel=0.03) and second.std().item() == pytest.approx(0.2, rel=0.03)
    assert torch.corrcoef(torch.stack([first, second]))[0, 1].item() == pytest.approx(correlation, abs=0.02)


@pytest.mark.parametrize("wind", [0.0, 0.5])
def test_a_restored_sampler_goes_on_exactly(bank, wind):
    config = replace(CONFIG, wind_fraction=wind)
    sampler, other = (WindowSampler(bank, config, 3, generator(seed)) for seed in (1, 2))
    sampler.advance(torch.randn(2, 6, 3))
    other.restore({name: value.clone() for name, value in sampler.state().items()})
    for _ in range(5):
        assert torch.equal(sampler.noise(), other.noise())
        for one in (sampler, other):
            one.advance(torch.ones(2, 6, 3))
        assert all(torch.equal(a, b) for a, b in zip(sampler.state().values(), other.state().values()))


def test_a_window_longer_than_every_clip_is_refused(bank):
    with pytest.raises(SsilkError, match=r"longest clip has 23 frames.*window of 24 poses must fit.*window=N"):
        WindowSampler(bank, replace(CONFIG, window=24), 3, generator())


def test_a_carried_window_is_displaced_now_and_then_and_a_new_one_always(bank):
    config = replace(CONFIG, batch=4000, noise_probability=0.1, noise=1.0)
    sampler = WindowSampler(bank, config, 3, generator())
    sampler.carried[:] = torch.arange(4000) < 3000
    moved = (sampler.noise() != 0).all(dim=2).all(dim=0)
    assert moved[3000:].all()
    assert moved[:3000].double().mean().item() == pytest.approx(1 - 0.9**3, abs=0.03)  # three new frames


def test_motions_are_cut_where_a_joint_flips(scene, toy_motion):
    smooth = toy_motion(scene, 40)
    rotations = smooth.rotations.copy()
    rotations[25:, 2] = rotations[25:, 2] @ np.diag([1.0, 1, 1, 1])[[1, 0, 3, 2]]  # half a turn between two frames
    flipped = replace(smooth, rotations=rotations)
    cut = build_bank([flipped], scene.character.skeleton, JOINTS, 30.0, CPU, max_joint_speed=40.0)
    assert cut.stops.tolist() == [25, 40]
    for motion, turn in ((flipped, np.inf), (smooth, 40.0)):
        assert build_bank(
            [motion], scene.character.skeleton, JOINTS, 30.0, CPU, max_joint_speed=turn
        ).stops.tolist() == [40]
