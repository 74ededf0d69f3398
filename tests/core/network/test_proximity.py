# SPDX-License-Identifier: Apache-2.0
"""Networks that see colliders: one result in every player, and motions of other garments are refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssilk_core.errors import SsilkError
from ssilk_core.network.checkpoint import model_file
from ssilk_core.network.model.batch import motion_inputs
from ssilk_core.network.rollout import decode, garment_poses
from ssilk_core.network.runtime import Player
from ssilk_core.scene.fabrics import FABRICS
from ssilk_core.scene.kinematics import split_at_cuts

POINTS, FRAMES = 5, 60


@pytest.fixture(scope="module")
def seeing(scene, toy_model):
    return toy_model(scene, scale=0.1, proximity_points=POINTS).eval()


@pytest.fixture
def motion(scene, toy_motion):
    """A motion with a cut past something that comes near."""
    plain, frames = toy_motion(scene, FRAMES), np.arange(FRAMES)
    moved = plain.translations.copy()
    moved[25:, 0, 0] += 50
    share = 0.15 * np.sin(0.2 * frames[:, None, None] + np.arange(POINTS)[:, None])
    away = np.broadcast_to([0.6, 0.8, 0.0], (FRAMES, POINTS, 3))
    return replace(plain, translations=moved, proximity=np.concatenate([away, share, 0.3 - 2 * share], axis=2))


def vertices(player: Player, motion) -> np.ndarray:
    playback = player.play(motion)
    return np.stack([playback.vertices(frame) for frame in range(motion.frame_count)])


def test_players_agree_on_what_is_near(scene, seeing, motion) -> None:
    assert len(split_at_cuts(motion, scene.character.skeleton)) == 2
    player = Player(model_file(seeing, FABRICS["silk"], {}))
    without = replace(motion, proximity=None)
    played = {}
    for name, each in (
        ("near", motion),
        ("without", without),
        ("nothing", replace(motion, proximity=motion.proximity * 0 + [0, 0, 0, 1, -1])),
    ):
        poses = garment_poses(seeing, each, each.fps)
        played[name] = vertices(player, each)
        torch_points = np.concatenate([decode(seeing, each, pose) for pose in poses])
        np.testing.assert_allclose(played[name], torch_points, atol=1e-5)
    assert np.abs(played["near"] - played["without"]).max() > 1e-3
    np.testing.assert_array_equal(played["nothing"], played["without"])
    batch = motion_inputs(seeing, [motion.clip(0, 20), without.clip(0, 20)])
    for shot, each in enumerate((motion, without)):
        alone = motion_inputs(seeing, [each.clip(0, 20)])
        np.testing.assert_allclose(batch.pose[:, shot], alone.pose[:, 0], atol=1e-6)


def test_another_garments_proximity_is_refused_in_one_sentence(scene, seeing, toy_model, motion) -> None:
    other = replace(motion, proximity=motion.proximity[:, :2])
    for model, given, words in (
        (seeing, other, f"proximity at 2 points; this network sees it at {POINTS}"),
        (toy_model(scene).eval(), motion, f"proximity at {POINTS} points; this network sees it at 0"),
    ):
        with pytest.raises(SsilkError, match=words):
            vertices(Player(model_file(model, FABRICS["silk"], {})), given)
        with pytest.raises(SsilkError, match=words):
            list(garment_poses(model, given, given.fps))
