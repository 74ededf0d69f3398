# SPDX-License-Identifier: Apache-2.0
"""Edges, hinges, areas, normals and components against counts and closed forms."""

import numpy as np
import pytest
import scipy.sparse as sparse
import trimesh

from ssilk_core.scene.mesh import topology

RNG = np.random.default_rng(3)
SQUARE_POINTS = np.array([[0.0, 0, 0], [2, 0, 0], [2, 0, -2], [0, 0, -2]])
SQUARE = np.array([[0, 1, 2], [0, 2, 3]])


@pytest.fixture(scope="module")
def sphere() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=3, radius=1.0)


def test_edges_of_a_closed_surface_satisfy_euler(sphere):
    found = topology.edges(sphere.faces)
    assert len(sphere.vertices) - len(found) + len(sphere.faces) == 2
    assert (found[:, 0] < found[:, 1]).all()
    assert not topology.border_vertices(sphere.faces, len(sphere.vertices)).any()


def test_border_of_a_square_is_all_four_corners_and_its_diagonal_is_inside():
    pairs, uses = topology.edge_use(SQUARE)
    assert uses.tolist() == [2 if (pair == [0, 2]).all() else 1 for pair in pairs]
    assert topology.border_vertices(SQUARE, 5).tolist() == [True, True, True, True, False]


def test_hinge_runs_along_its_first_face():
    assert topology.hinges(SQUARE).tolist() == [[2, 0, 1, 3]]


def test_hinges_of_a_closed_surface_are_its_edges_with_their_faces(sphere):
    hinges = topology.hinges(sphere.faces)
    assert sorted(map(tuple, np.sort(hinges[:, :2], axis=1))) == sorted(map(tuple, topology.edges(sphere.faces)))
    cycles = {tuple(np.roll(face, shift)) for face in sphere.faces for shift in range(3)}
    assert all((v0, v1, o0) in cycles and (v1, v0, o1) in cycles for v0, v1, o0, o1 in hinges)


def test_edge_of_three_faces_has_no_hinge():
    fin = np.vstack([SQUARE, [[0, 2, 4]]])
    assert len(topology.hinges(fin)) == 0


def test_areas_and_normals_of_a_square():
    np.testing.assert_allclose(topology.face_areas(SQUARE_POINTS, SQUARE), [2, 2])
    np.testing.assert_allclose(topology.vertex_areas(SQUARE_POINTS, SQUARE), [4 / 3, 2 / 3, 4 / 3, 2 / 3])
    np.testing.assert_allclose(topology.vertex_normals(SQUARE_POINTS, SQUARE), [[0, 1, 0]] * 4)


def test_vertex_areas_add_up_and_normals_of_a_sphere_are_radial(sphere):
    assert np.isclose(topology.vertex_areas(sphere.vertices, sphere.faces).sum(), sphere.area)
    # Each level of subdivision halves the angle of an edge; at level 3 normals are within half an edge angle.
    cosine = np.sum(topology.vertex_normals(sphere.vertices, sphere.faces) * sphere.vertices, axis=1)
    assert cosine.min() > np.cos(np.radians(63.4 / 8 / 2))


def test_vertices_of_a_degenerate_triangle_have_no_normal():
    assert not topology.vertex_normals(SQUARE_POINTS, np.array([[0, 1, 1]])).any()


def test_components_agree_with_scipy():
    pairs = RNG.integers(0, 400, size=(300, 2))
    graph = sparse.coo_matrix((np.ones(len(pairs)), pairs.T), shape=(400, 400))
    expected = sparse.csgraph.connected_components(graph, directed=False)[1]
    np.testing.assert_array_equal(topology.components(pairs, 400), expected)


def test_islands_count_lone_vertices():
    two = np.vstack([SQUARE, SQUARE + 4])
    assert topology.islands(two, 9).tolist() == [0, 0, 0, 0, 1, 1, 1, 1, 2]


def test_smoothing_is_the_mean_with_neighbours_and_keeps_lone_rows(sphere):
    values = np.array([[0.0], [3.0], [6.0], [5.0]])
    chain = np.array([[0, 1], [1, 2]])
    np.testing.assert_allclose(topology.smooth(values, chain, 1), [[1.5], [3.0], [4.5], [5.0]])
    np.testing.assert_array_equal(topology.smooth(values, chain, 0), values)
    free = np.array([True, False, True, True])
    np.testing.assert_allclose(topology.smooth(values, chain, 2, free), [[2.25], [3.0], [3.75], [5.0]])
    flat = topology.smooth(np.ones((len(sphere.vertices), 2)), topology.edges(sphere.faces), 20)
    np.testing.assert_allclose(flat, 1)
