# SPDX-License-Identifier: Apache-2.0
"""Motions that repeat: where a round leads, what its end misses, and rounds one after the other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssilk_core.scene.assets import Motion
from ssilk_core.scene.cycles import find_cycle, rounds
from ssilk_core.scene.kinematics import motion_transforms, multiply_quaternions

FRAMES, SIZE = 20, 1.0


def gait(scene, frames: int = FRAMES + 1, *, turn: float = 0.0, way: float = 0.0) -> Motion:
    """A cycle of `FRAMES` frames whose root sways on an arc: `turn` [rad] and `way` [m] of each round."""
    at, joints = np.arange(frames), scene.character.skeleton.joint_count
    phase = 2 * np.pi * at / FRAMES
    rotations = np.zeros((frames, joints, 4))
    half = 0.2 * np.sin(phase[:, None] + np.arange(joints))
    rotations[..., 0], rotations[..., 1] = np.cos(half), np.sin(half)
    heading = turn * at / FRAMES
    about = np.stack([np.cos(heading / 2), 0 * at, np.sin(heading / 2), 0 * at], axis=-1)
    rotations[:, 0] = multiply_quaternions(about, rotations[:, 0])
    translations = np.tile(scene.character.skeleton.rest_transforms[:, :3, 3], (frames, 1, 1))
    steps = way / FRAMES * np.stack([np.sin(heading), 0 * at, np.cos(heading)], axis=-1)
    translations[:, 0] += np.cumsum(np.concatenate([0 * steps[:1], steps[:-1]]), axis=0)
    return Motion("walk", 30.0, rotations, translations)


@pytest.mark.parametrize(("turn", "way"), [(0.0, 0.0), (0.0, 1.3), (0.5, 0.9), (-2.0, 0.4)])
def test_a_cycle_is_found_wherever_it_leads(scene, turn, way):
    motion = gait(scene, turn=turn, way=way)
    found = find_cycle(motion, scene.character.skeleton, SIZE)
    assert found.closed and found.frames == FRAMES and found.gap < 1e-12
    assert found.angle == pytest.approx(turn, abs=1e-12)
    world = motion_transforms(motion, scene.character.skeleton.parents)[..., :3, 3]
    np.testing.assert_allclose(found.back(world[-1]), world[0], atol=1e-12)
    assert found.travel(world[0, 0]) == pytest.approx(np.linalg.norm(world[-1, 0] - world[0, 0]), abs=1e-12)


@pytest.mark.parametrize(("turn", "way"), [(0.0, 0.0), (0.5, 0.9)])
def test_rounds_go_on_where_the_motion_does(scene, turn, way):
    """Whether the last frame shows the first one's pose or the one before."""
    skeleton, long = scene.character.skeleton, gait(scene, 3 * FRAMES, turn=turn, way=way)
    wanted = motion_transforms(long, skeleton.parents)
    for frames, error in ((FRAMES + 1, 1e-12), (FRAMES, 3e-3)):  # the second is interpolated across the seam
        own = gait(scene, frames, turn=turn, way=way)
        found = find_cycle(own, skeleton, SIZE)
        assert (found.closed, found.frames) == (frames > FRAMES, FRAMES)
        many = motion_transforms(rounds(own, skeleton, found, 3), skeleton.parents)
        np.testing.assert_allclose(many, wanted, atol=error)


def test_what_the_end_misses_is_told_and_spread_over_the_rounds(scene):
    skeleton, motion = scene.character.skeleton, gait(scene, way=1.0)
    places = motion.translations.copy()
    places[:, 0, 1] += 0.02 * np.arange(len(places)) / FRAMES  # it rises: where a round leads, not what it misses
    places[:, 1] += np.array([0.0, 0.0, 0.03]) * np.arange(len(places))[:, None] / FRAMES
    off = replace(motion, translations=places)
    found = find_cycle(off, skeleton, SIZE)
    assert 0.01 < found.gap < 0.03 and found.step[1] == pytest.approx(0.02, abs=2e-3)
    many = rounds(off, skeleton, found, 3)
    np.testing.assert_allclose(
        many.translations[FRAMES::FRAMES, 1], many.translations[:-FRAMES:FRAMES, 1], atol=1e-12
    )
    world = motion_transforms(many, skeleton.parents)[..., :3, 3]
    steps = np.linalg.norm(np.diff(world, axis=0), axis=-1).max(axis=1)
    assert steps[FRAMES - 1] < 1.1 * np.median(steps)  # no jump at the seam


def test_another_pose_at_the_end_is_a_gap(scene):
    motion = gait(scene)
    found = find_cycle(motion.clip(0, FRAMES // 2), scene.character.skeleton, SIZE)
    assert found.gap > 0.02
    with pytest.raises(ValueError, match="3 frames"):
        find_cycle(motion.clip(0, 3), scene.character.skeleton, SIZE)


def test_what_is_seen_of_colliders_turns_along(scene):
    motion = gait(scene, turn=np.pi / 2)
    near = np.zeros((motion.frame_count, 2, 5))
    near[..., 0], near[..., 3], near[..., 4] = 1.0, 0.5, 0.3
    seen = replace(motion, proximity=near)
    skeleton = scene.character.skeleton
    found = rounds(seen, skeleton, find_cycle(seen, skeleton, SIZE), 2)
    np.testing.assert_allclose(found.proximity[0, 0], [1, 0, 0, 0.5, 0.3], atol=1e-12)
    np.testing.assert_allclose(found.proximity[FRAMES, 0], [0, 0, -1, 0.5, 0.3], atol=1e-12)
