# SPDX-License-Identifier: Apache-2.0
"""How a garment lies over another: intersections between them, and inner cloth that shows."""

import numpy as np
import pytest
import trimesh

from ssilk_core.physics.intersections.layers import ClothLayers, LayerCounts
from ssilk_core.scene.assets import Mesh


def ball(radius: float) -> Mesh:
    found = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    return Mesh(f"/ball{radius}", found.vertices, found.faces)


@pytest.fixture(scope="module")
def layers() -> ClothLayers:
    inner = ball(0.21)
    wound = inner.faces.copy()
    wound[::2] = wound[::2, ::-1]
    return ClothLayers(("coat", "shirt"), ball(0.23), Mesh("/shirt", inner.points, wound), ball(0.2))


def test_what_lies_over_all_intersects_nothing_and_shows_nothing(layers):
    found = layers.counts([ball(0.23).points] * 2, [ball(0.21).points] * 2, [3.0, 4.0])
    assert layers.covered == 4000
    assert found.shares.tolist() == [0, 0] and found.shown.tolist() == [0, 0] and found.frames.tolist() == [3, 4]


def test_cloth_that_is_wholly_beneath_intersects_nothing_and_all_of_the_inner_one_shows(layers):
    found = layers.counts([ball(0.2).points], [ball(0.21).points], [0.0])
    assert found.shares[0] == 0 and found.shown[0] == pytest.approx(1, abs=1e-3)


def test_a_ball_moved_through_another_intersects_in_a_ring_and_shows_as_a_cap(layers):
    """Balls of one radius r meet in a plane between them: d apart, (1 + d / 2r) / 2 of the inner one lie beyond."""
    moved = ball(0.21).points + [0.0, 0.02, 0.0]
    found = layers.counts([moved], [ball(0.21).points], [0.0])
    ring = np.abs(moved[layers.outer.faces][..., 1].mean(axis=1) - 0.01) < 0.04
    assert 0 < found.shares[0] <= ring.mean()
    assert found.shown[0] == pytest.approx(0.5 * (1 + 0.01 / 0.21), abs=0.01)


def test_frames_that_are_not_finite_count_whole(layers):
    bad = ball(0.23).points.copy()
    bad[5] = np.nan
    found = layers.counts([bad, ball(0.23).points], [ball(0.21).points] * 2, [0.0, 1.0])
    assert found.shares.tolist() == [1, 0] and found.shown.tolist() == [1, 0]


def test_figures_tell_mean_and_worst_of_all_clips(layers):
    one = LayerCounts(np.array([0.0, 0.1]), np.array([0.0, 0.02]), np.array([0.0, 4.0]))
    other = LayerCounts(np.array([0.3, 0.0]), np.array([0.04, 0.0]), np.array([8.0, 12.0]))
    found = layers.figures([("walk", one), ("run", other)])
    assert (found.mean, found.worst, found.clip, found.frame) == (0.1, 0.3, "run", 8.0)
    assert (found.shown, found.worst_shown, found.frames) == (pytest.approx(0.015), 0.04, 4)
    assert "10.000% of the triangles intersect shirt" in str(found) and "1.500% of shirt shows" in str(found)
    assert found.to_metadata()["outer"] == "coat" and len(found.summary()) == 2


def test_garments_that_cover_nothing_of_each_other_show_nothing(layers):
    far = Mesh("/hat", ball(0.05).points + [0, 2.0, 0], ball(0.05).faces)
    apart = ClothLayers(("hat", "shirt"), far, ball(0.21), ball(0.2))
    counts = apart.counts([far.points], [ball(0.21).points], [0.0])
    assert counts.shown is None and apart.figures([("clip", counts)]).shown is None
