# SPDX-License-Identifier: Apache-2.0
"""Surfaces, normals and colours of pictures."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from ssilk_core.delivery.view.colours import fabric_colour
from ssilk_core.delivery.view.surface import Geometry, Surface, vertex_normals
from ssilk_core.errors import SsilkError

TRIANGLE = np.eye(3)
GREY = np.full(3, 0.5)


def test_normals_of_a_sphere_are_its_radii():
    ball = trimesh.creation.icosphere(subdivisions=4)
    normals = vertex_normals(ball.vertices, ball.faces)
    # Faces lean by up to 0.04 rad against the radii of their corners; the mean over a ring cancels most of it.
    np.testing.assert_allclose(normals, ball.vertices, atol=0.01)


def test_a_vertex_without_faces_has_a_unit_normal():
    normals = vertex_normals(np.vstack([TRIANGLE, [5.0, 5.0, 5.0]]), np.array([[0, 1, 2]]))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)


def test_geometry_keeps_the_order_of_its_surfaces():
    first = Surface("first", TRIANGLE, np.array([[0, 1, 2]]), GREY)
    second = Surface("second", TRIANGLE + 1, np.array([[2, 1, 0]]), np.eye(3), two_sided=True)
    joined = Geometry.of([first, second])
    np.testing.assert_array_equal(joined.faces, [[0, 1, 2], [5, 4, 3]])
    np.testing.assert_array_equal(joined.thin, [False] * 3 + [True] * 3)
    np.testing.assert_array_equal(joined.outside[3:], np.eye(3))
    np.testing.assert_array_equal(joined.inside[:3], joined.outside[:3])
    assert (joined.inside[3:].sum(axis=1) < joined.outside[3:].sum(axis=1)).all()


@pytest.mark.parametrize(
    ("points", "faces", "colour", "message"),
    [
        (np.eye(3)[:, :2], [[0, 1, 2]], GREY, "shape"),
        (np.full((3, 3), np.nan), [[0, 1, 2]], GREY, "3 of 3 points hold NaN"),
        (np.eye(3), [[0, 1, 3]], GREY, "1 face indices"),
        (np.eye(3), [[0, 1, 2]], np.ones((2, 3)), "colours of shape"),
    ],
)
def test_malformed_surfaces_are_named(points, faces, colour, message):
    with pytest.raises(SsilkError, match=rf"surface 'hem': .*{message}"):
        Surface("hem", points, np.array(faces), colour)


def test_neighbouring_garments_differ():
    assert np.abs(fabric_colour(0) - fabric_colour(1)).max() > 0.2
