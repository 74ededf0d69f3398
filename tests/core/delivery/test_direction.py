# SPDX-License-Identifier: Apache-2.0
"""Which samples of a shot get poses of their own, and where the network is rolled out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssilk_core.delivery.bake.direction import Direction, free_stretches


@pytest.mark.parametrize(
    ("free", "stretches"),
    [
        ([1, 1, 1], [(0, 3)]),
        ([0, 0, 0], []),
        ([0, 0, 0.5, 1, 0.2, 0, 0], [(1, 5)]),
        ([1, 0, 0.1], [(0, 1), (1, 3)]),
        ([0, 1, 0, 1], [(0, 2), (2, 4)]),
    ],
)
def test_the_network_begins_in_the_last_frame_that_is_held_in_full(free, stretches):
    assert free_stretches(np.array(free, dtype=float)) == stretches


def test_held_poses_are_counted_from_the_first_frame_and_anew_after_a_cut(scene, toy_motion):
    motion = toy_motion(scene, 12)
    places = motion.translations.copy()
    places[7:, 0] += [9.0, 0, 0]
    motion = replace(motion, translations=places)
    direction = Direction(np.ones(12), 3, motion, 2)
    runs = direction.runs(scene.character.skeleton)
    np.testing.assert_array_equal(np.concatenate(runs), [2, 5, 7, 10])
    assert [len(run) for run in runs] == [2, 2]
    np.testing.assert_array_equal(direction.shown(np.concatenate(runs)), [0, 0, 0, 0, 0, 1, 1, 2, 2, 2, 3, 3])
    (whole,) = replace(direction, hold=1).runs(scene.character.skeleton)
    np.testing.assert_array_equal(whole, np.arange(12))


def test_no_pose_of_before_a_cut_is_shown_after_it(scene, toy_motion):
    """Held poses are counted from frame 6, the shot's first; handles begin with a frame of another take."""
    motion = toy_motion(scene, 12)
    places = motion.translations.copy()
    places[1:, 0] += [9.0, 0, 0]
    direction = Direction(np.ones(12), 4, replace(motion, translations=places), 6)
    made = np.concatenate(direction.runs(scene.character.skeleton))
    assert {0, 2, 6, 10} <= set(made)
    assert (made[direction.shown(made)][1:] >= 1).all()
