# SPDX-License-Identifier: Apache-2.0
"""Rollouts that are lost: the garment is put to rest, goes on, and it is said where."""

from collections.abc import Container
from dataclasses import replace
from itertools import count

import numpy as np
import pytest
import torch

from ssilk_core.network.model.network import GarmentModel
from ssilk_core.network.rollout import RECOVERY_FRAMES, garment_poses, roll, roll_blocks
from ssilk_core.network.settings import ModelConfig
from ssilk_core.scene.assets import Motion, Skeleton
from ssilk_core.scene.kinematics import split_at_cuts


def poison(model: GarmentModel, when: Container[int]) -> None:
    """Let a model lose its state at the steps in `when`, counted from zero."""
    follow, steps = model.integrator.step, count()

    def poisoned(*inputs: object) -> torch.Tensor:
        given = follow(*inputs)
        return given * torch.nan if next(steps) in when else given

    model.integrator.step = poisoned


@pytest.fixture
def model(scene, toy_model):
    return toy_model(scene, scale=0.1).eval()


def recovered(steps) -> list[int]:
    return [step.start + int(frame) for step in steps for frame in step.recovered.nonzero()]


@pytest.mark.parametrize("chunk", [7, 30, 100])
def test_a_lost_state_rests_and_the_rollout_goes_on(model, scene, toy_motion, chunk):
    """The twentieth step is frame 21: the first two frames are at rest."""
    motion = toy_motion(scene, 80)
    calm = torch.cat([step.activation for step in roll(model, motion, 100)], dim=1)
    poison(model, {19})
    steps = list(roll(model, motion, chunk))
    frames, found = recovered(steps), torch.cat([step.activation for step in steps], dim=1)
    rests = frames[-1] - frames[0] + 1
    assert frames == list(range(21, 21 + rests)) and rests <= RECOVERY_FRAMES
    assert rests == RECOVERY_FRAMES or (frames[-1] + 1) % chunk == 0
    assert found.isfinite().all() and (found[:, :21] - calm[:, :21]).abs().max() < 1e-4
    assert (found[:, 22:] - calm[:, 22:]).abs().amax(dim=0).min() > 0 and len(found[0]) == 80


def test_a_rollout_that_is_always_lost_is_quasi_static(model, scene, toy_motion):
    motion = toy_motion(scene, 50)
    poison(model, range(10_000))
    (step,) = roll(model, motion, 100)
    assert step.recovered[2:].all() and step.activation.isfinite().all()
    assert step.activation.diff(dim=1).abs().amax(dim=0).min() > 0  # it follows the poses


def test_a_decoder_that_fails_leaves_the_rig_as_it_is(model, scene, toy_motion):
    with torch.no_grad():
        model.output[-1].bias.fill_(torch.nan)
    (step,) = roll(model, toy_motion(scene, 10), 100)
    assert step.recovered.all() and not step.activation.any()
    torch.testing.assert_close(step.transforms, torch.eye(3, 4)[None, :, :, None].expand_as(step.transforms))


def test_a_free_latent_that_runs_away_is_caught(scene, toy_model, toy_motion):
    model = toy_model(scene, scale=0.1).eval()
    model.integrator.config = replace(model.config, latent_bound=0.0, max_latent_step=0.0)
    with torch.no_grad():
        model.integrator.beta.fill_(-3.0)
    steps = list(roll(model, toy_motion(scene, 200)))
    frames = recovered(steps)
    assert frames and frames[0] > 2
    assert all(step.activation.isfinite().all() for step in steps)


@pytest.mark.parametrize("size", [1, 2, 3, 17])
def test_blocks_give_what_the_whole_motion_gives(model, scene, toy_motion, size):
    motion = toy_motion(scene, 40)
    blocks = (motion.clip(start, min(start + size, 40)) for start in range(0, 40, size))
    whole = torch.cat([step.activation for step in roll(model, motion)], dim=1)
    found = torch.cat([step.activation for step in roll_blocks(model, blocks)], dim=1)
    torch.testing.assert_close(found, whole, atol=1e-4, rtol=0)


@pytest.mark.parametrize(("source", "target"), [(30.0, 30.0), (30.0, 60.0), (24.0, 24.0), (60.0, 24.0)])
def test_the_frames_that_are_told_are_those_that_differ(model, scene, toy_motion, source, target):
    motion = toy_motion(scene, 90, source)
    calm = list(garment_poses(model, motion, target))
    poison(model, {19})
    told: list[range] = []
    lost = list(garment_poses(model, motion, target, on_recovery=told.append))
    moved = np.concatenate([np.abs(a.weights - b.weights).max(axis=1) for a, b in zip(calm, lost)])
    (frames,) = told
    first = int(np.flatnonzero(moved)[0])
    assert frames[0] == first == int(np.floor(20 / 30 * target + 1e-6)) + 1
    assert frames[-1] == int(np.ceil((21 + RECOVERY_FRAMES) / 30 * target - 1e-6)) - 1


ONE_JOINT = Skeleton("/Rig", ("Hips",), [-1], *[np.eye(4)[None]] * 2)


def flight(speeds: np.ndarray) -> Motion:
    """A single joint that flies along x at a speed [m/s] in each frame."""
    places = np.zeros((len(speeds) + 1, 1, 3))
    places[1:, 0, 0] = np.cumsum(speeds) / 30
    return Motion("/flight", 30.0, np.tile([1.0, 0, 0, 0], (len(places), 1, 1)), places)


def test_a_fast_ride_is_no_cut_and_a_jump_on_it_is():
    steady = np.full(60, 50.0)
    assert len(split_at_cuts(flight(steady), ONE_JOINT)) == 1
    assert len(split_at_cuts(flight(np.linspace(0, 90, 60)), ONE_JOINT)) == 1
    steady[30] = 400
    assert [span.frame_count for span in split_at_cuts(flight(steady), ONE_JOINT)] == [31, 30]


@pytest.mark.parametrize("at", [0, 7, 58])
def test_a_jump_anywhere_is_a_cut(at):
    speeds = np.zeros(59)
    speeds[at] = 300
    assert [span.frame_count for span in split_at_cuts(flight(speeds), ONE_JOINT)] == [at + 1, 59 - at]


def test_a_calm_garment_sleeps_while_its_character_holds_still_and_wakes(scene, toy_motion):
    """All springs of a fresh spring scheme are made quick, so that it comes to rest within the first block."""
    config = ModelConfig(latent=6, widths=(16,), shapes=4, scheme="spring_verlet")
    model = GarmentModel(scene, config, np.arange(3)).eval()
    with torch.no_grad():
        model.integrator.share.fill_(3.0)
        model.output[-1].weight.mul_(100)
    clip = toy_motion(scene, 60)
    order = np.concatenate([np.arange(60), np.full(440, 59), np.arange(59, -1, -1)])
    motion = replace(clip, rotations=clip.rotations[order], translations=clip.translations[order])
    steps = list(roll(model, motion, 100))
    found = torch.cat([step.activation for step in steps], dim=1)
    assert not found[:, 300:500].diff(dim=1).any() and found[:, 500:].diff(dim=1).abs().max() > 1e-3
    assert [step.start for step in steps] == [0, 100, 200, 300, 400, 500]
    whole = torch.cat([step.activation for step in roll(model, motion, 560)], dim=1)  # one block, never asleep
    torch.testing.assert_close(found, whole, atol=1e-4, rtol=0)
