# SPDX-License-Identifier: Apache-2.0
"""Many shots at once are what each of them is alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ssilk_core.errors import SsilkError
from ssilk_core.network.model.batch import BatchPlayer, motion_inputs
from ssilk_core.network.rollout import decode, garment_poses, roll
from ssilk_core.scene.kinematics import split_at_cuts

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


@pytest.fixture(params=DEVICES)
def model(request, scene, toy_model):
    return toy_model(scene, scale=0.1).eval().to(request.param)


@pytest.fixture
def motions(scene, toy_motion):
    """Four shots: two of them shorter, one backwards, and one with a cut."""
    motion = toy_motion(scene, 25)
    back = replace(motion, rotations=motion.rotations[::-1], translations=motion.translations[::-1] + [80.0, 0, 5])
    jumps = motion.translations + [0.0, 0.0, 40.0] * (np.arange(25) >= 9)[:, None, None]
    return [motion, motion.clip(5, 12), back, replace(motion, translations=jumps)]


def test_vertices_are_those_of_each_shot_alone(model, motions):
    shots = motion_inputs(model, motions)
    player = BatchPlayer(model, shots)
    for _ in range(2):  # the second time from where the first one ended
        frames = torch.stack([each.clone() for each in player.play(shots)]).double() + shots.origins[:, None]
        found = frames.permute(3, 0, 1, 2).cpu().numpy()
        for mine, motion in zip(found, motions):
            theirs = np.concatenate([decode(model, motion, pose) for pose in garment_poses(model, motion, 30.0)])
            np.testing.assert_allclose(mine[: len(theirs)], theirs, atol=2e-5)


def test_the_network_alone_gives_what_the_decoder_takes(model, motions):
    shots = motion_inputs(model, motions)
    player = BatchPlayer(model, shots, vertices=False)
    outputs = torch.stack([each.clone() for each in player.play(shots)], dim=1)
    for mine, motion in zip(outputs, motions):
        activation, _ = model.decoder.activations(mine[: motion.frame_count])
        spans = split_at_cuts(motion, model.scene.character.skeleton)
        alone = torch.cat([next(roll(model, span)).activation for span in spans], dim=1)
        torch.testing.assert_close(activation, alone, atol=1e-5, rtol=0)


def test_a_motion_of_another_rate_is_refused(model, motions):
    with pytest.raises(SsilkError, match="24 frames per second; the model steps at 30"):
        motion_inputs(model, [motions[0], replace(motions[1], fps=24.0)])
