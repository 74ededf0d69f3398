# SPDX-License-Identifier: Apache-2.0
"""Classes as numbers and colours, without Blender."""

from __future__ import annotations

import numpy as np
import pytest

from blender_addon.arrays import classes as palette


def test_vertices_of_islands_that_are_all_loose_fall_off():
    island = np.array([0, 0, 0, 1, 1, 2, 2, 3])
    assert palette.adrift(np.array([0, 2, 2, 2, 2, 1, 2, 2]), island).nonzero()[0].tolist() == [3, 4, 7]
    assert not palette.adrift(np.array([0, 2, 2, 1, 2, 1, 2, 0]), island).any()


def test_colors_and_classes_are_each_others_inverse():
    values = np.array([0, 1, 2, 2, 0])
    assert np.array_equal(palette.nearest(palette.colors_of(values)), values)


@pytest.mark.parametrize(
    "color, value",
    [((0.4, 0.0, 0.0), 0), ((0.6, 0.1, 0.0), 1), ((0.3, 0.55, 0.0), 2), ((1.0, 1.0, 0.9), 1), ((0.2, 0.2, 0.2), 0)],
)
def test_the_nearest_color_wins(color, value):
    assert palette.nearest(np.array([color])) == [value]


def test_corner_colors_are_averaged_on_points():
    colors = np.array([[1.0, 0, 0, 1], [0, 1.0, 0, 1], [0, 1.0, 0, 1]])
    found = palette.point_colors(colors, np.array([0, 2, 2]), 3)
    assert np.array_equal(found, [[1, 0, 0, 1], [0, 0, 0, 0], [0, 1, 0, 1]])


def test_mirroring_takes_from_the_named_side_only():
    points = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0.0, 0, 0], [-2.0, 0, 0]])
    partners, values = np.array([1, 0, 2, -1]), np.array([2, 0, 1, 0])
    assert palette.mirrored(values, points, partners, from_left=True).tolist() == [2, 2, 1, 0]
    assert palette.mirrored(values, points, partners, from_left=False).tolist() == [0, 0, 1, 0]
