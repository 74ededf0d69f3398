# SPDX-License-Identifier: Apache-2.0
"""Geodesic distances against closed forms on surfaces that unroll, and the evenness of samples."""

import numpy as np
import pytest

from ssilk_core.scene.mesh import geodesic


def grid(rows: int, columns: int, spacing: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """A flat sheet in the plane z = 0, vertex r * columns + c at (c, r) * spacing."""
    r, c = np.divmod(np.arange(rows * columns), columns)
    corner = np.flatnonzero((r < rows - 1) & (c < columns - 1))
    lower = np.column_stack([corner, corner + 1, corner + columns + 1])
    upper = np.column_stack([corner, corner + columns + 1, corner + columns])
    return np.column_stack([c, r, np.zeros(len(r))]) * spacing, np.concatenate([lower, upper])


def rolled(points: np.ndarray, radius: float) -> np.ndarray:
    """Bend a flat sheet about the y axis without stretching its rows (chords stand in for arcs)."""
    angle = points[:, 0] / radius
    return np.column_stack([radius * np.sin(angle), points[:, 1], radius * np.cos(angle)])


def test_flat_distance_is_euclidean_in_every_direction():
    points, faces = grid(12, 15)
    found = geodesic.distances(points, faces, np.array([37]))
    np.testing.assert_allclose(found, np.linalg.norm(points - points[37], axis=1), atol=1e-12)


def test_cylinder_distance_is_that_of_the_unrolled_sheet():
    flat, faces = grid(10, 30)
    radius = 1.0
    found = geodesic.distances(rolled(flat, radius), faces, np.array([0]))
    # A chord of a step s is 2 r sin(s / 2r) long: the faceted cylinder unrolls exactly onto a narrower sheet.
    narrower = flat * [2 * radius * np.sin(0.1 / (2 * radius)) / 0.1, 1, 1]
    np.testing.assert_allclose(found, np.linalg.norm(narrower - narrower[0], axis=1), atol=1e-12)


def test_several_sources_give_the_nearest_and_name_it():
    points, faces = grid(9, 9)
    sources = np.array([0, 8, 76])
    each = np.array([geodesic.distances(points, faces, np.array([source])) for source in sources])
    distance, nearest = geodesic.nearest_sources(points, faces, sources)
    np.testing.assert_allclose(distance, each.min(axis=0), atol=1e-12)
    ordered = np.sort(each, axis=0)
    clear = ordered[1] - ordered[0] > 0.1 * np.sqrt(2)
    assert clear.sum() > 40
    np.testing.assert_array_equal(nearest[clear], sources[each.argmin(axis=0)][clear])


@pytest.mark.parametrize("reach", [0.0, 0.1, 0.25, 0.6])
@pytest.mark.parametrize("sources", [[], [112], [0, 5, 200]])
def test_what_lies_within_reach_is_what_the_distances_say(reach, sources):
    flat, faces = grid(15, 15)
    points = rolled(flat, 0.3) + np.random.default_rng(0).normal(0, 0.01, flat.shape)
    away = geodesic.distances(points, faces, np.array(sources, dtype=int))
    found = geodesic.within(points, faces, np.array(sources, dtype=int), reach)
    np.testing.assert_array_equal(found, away <= reach)
    assert found.any() == bool(sources)


def test_islands_and_lone_vertices_are_infinitely_far():
    points, faces = grid(4, 4)
    both = np.concatenate([points, points + [0, 0, 0.01], [[9.0, 9, 9]]])
    distance, nearest = geodesic.nearest_sources(both, np.concatenate([faces, faces + 16]), np.array([3]))
    assert np.isfinite(distance[:16]).all() and np.isinf(distance[16:]).all()
    assert (nearest[:16] == 3).all() and (nearest[16:] == -1).all()


def test_strips_side_by_side_are_far_apart_along_the_cloth():
    points, faces = grid(21, 5)
    slit = faces[(points[faces, 1].max(axis=1) <= 0.1 + 1e-9) | ~(faces % 5 == 2).any(axis=1)]
    left, right = 20 * 5 + 1, 20 * 5 + 3
    assert np.linalg.norm(points[left] - points[right]) < 0.21
    # Up one strip to the row that joins them, across, and down the other.
    expected = 2 * 1.9 + 0.2
    assert np.isclose(geodesic.distances(points, slit, np.array([left]))[right], expected, atol=1e-9)


@pytest.mark.parametrize(
    ("extra_points", "extra_faces", "expected"),
    [
        ([[-2.0, 0, 0], [-2.0, 0, -2]], [[0, 4, 5]], [2, np.sqrt(8)]),  # hangs on by one point
        ([[1.0, 1, -1]], [[0, 2, 4]], [np.sqrt(3)]),  # a fin on the diagonal: an edge of three faces
        ([], [[0, 1, 1]], []),  # a face that is an edge
    ],
)
def test_broken_meshes_are_measured_along_edges(extra_points, extra_faces, expected):
    points = np.array([[0.0, 0, 0], [2, 0, 0], [2, 0, -2], [0, 0, -2], *extra_points])
    faces = np.array([[0, 1, 2], [0, 2, 3], *extra_faces])
    found = geodesic.distances(points, faces, np.array([0]))
    np.testing.assert_allclose(found, [0, 2, np.sqrt(8), 2, *expected], atol=1e-12)


def test_samples_are_spread_almost_as_well_as_can_be():
    points, faces = grid(30, 30)
    samples, distances = geodesic.farthest_points(points, faces, start=0, count=20)
    assert len(set(samples)) == 20
    between = distances[:, samples] + np.where(np.eye(20), np.inf, 0)
    covered = distances.min(axis=0).max()
    # Farthest-point samples are no closer to each other than the farthest point is to them (Gonzalez 1985),
    # and 20 discs of that radius must cover the square.
    assert between.min() >= covered
    assert 20 * np.pi * covered**2 >= 2.9**2
    assert between.min() / between.min(axis=1).mean() > 0.8


def test_samples_run_out_with_the_vertices_of_the_island():
    points, faces = grid(2, 2)
    apart = np.concatenate([points, points + 5])
    samples, distances = geodesic.farthest_points(apart, np.concatenate([faces, faces + 4]), start=1, count=9)
    assert sorted(samples) == [0, 1, 2, 3]
    assert distances.shape == (4, 8)


def test_submesh_keeps_whole_faces_and_edges():
    faces = np.array([[0, 1, 2], [1, 3, 2], [3, 4, 5]])
    local, kept = geodesic.submesh(faces, np.array([True, True, True, True, True, False]))
    assert kept.tolist() == [0, 1, 2, 3, 4]
    real = local[(local[:, 1] != local[:, 2])]
    assert real.tolist() == [[0, 1, 2], [1, 3, 2]]
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [1, 2, 0]])
    np.testing.assert_allclose(geodesic.distances(points, local, np.array([1]))[[3, 4]], [1, 2])
