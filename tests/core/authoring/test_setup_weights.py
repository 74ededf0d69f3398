# SPDX-License-Identifier: Apache-2.0
"""Weights taken from a body: exact on its surface, smooth off it, whole at the joins."""

import numpy as np
import pytest
import trimesh

from ssilk_core.authoring.setup.surface import closest_on_surface
from ssilk_core.authoring.setup.weights import WeightOptions, transfer_weights
from ssilk_core.errors import SsilkError
from ssilk_core.scene.assets import LOOSE, TIGHT, Body, Character, Mesh, Skeleton, SkinWeights

RNG = np.random.default_rng(11)
RAW = WeightOptions(tight_rounds=0, loose_rounds=0)


@pytest.fixture(scope="module")
def character() -> Character:
    """A sphere of radius one, whose weights shift from one joint to the other with height."""
    sphere = trimesh.creation.icosphere(subdivisions=3)
    upper = (sphere.vertices[:, 1:2] + 1) / 2
    skin = SkinWeights("/Body", np.tile([0, 1], (len(upper), 1)), np.hstack([1 - upper, upper]))
    eye = np.tile(np.eye(4), (2, 1, 1))
    skeleton = Skeleton("/Rig", ("Low", "Low/High"), np.array([-1, 0]), eye, eye)
    return Character("/Character", skeleton, (Body(Mesh("/Body", sphere.vertices, sphere.faces), skin),))


def sheet(height: float, cells: int = 10) -> Mesh:
    side = np.linspace(-0.5, 0.5, cells + 1)
    x, z = np.meshgrid(side, side)
    at = np.arange(x.size).reshape(x.shape)
    quads = np.stack([at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]], axis=-1).reshape(-1, 4)
    points = np.column_stack([x.ravel(), np.full(x.size, height), z.ravel()])
    return Mesh("/Sheet", points, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]))


def test_garment_lying_on_the_body_gets_the_weights_under_it(character):
    body = character.merged_body()
    triangles = body.mesh.faces[RNG.integers(0, len(body.mesh.faces), 90)]
    where = RNG.dirichlet(np.ones(3), 90)
    points = np.einsum("vk,vkc->vc", where, body.mesh.points[triangles])
    garment = Mesh("/Garment", points, np.column_stack([np.zeros(88, int), *(np.arange(88) + k for k in (1, 2))]))
    expected = np.einsum("vk,vkj->vj", where, body.skin.dense(2)[triangles])
    np.testing.assert_allclose(transfer_weights(character, garment, options=RAW).dense(2), expected, atol=1e-9)


def test_body_itself_is_returned_exactly(character):
    body = character.merged_body()
    found = transfer_weights(character, body.mesh, options=RAW)
    np.testing.assert_allclose(found.dense(2), body.skin.dense(2), atol=1e-12)


def test_smoothing_narrows_the_range_and_keeps_rows_whole(character):
    garment = Mesh("/G", character.bodies[0].mesh.points * 1.1, character.bodies[0].mesh.faces)
    raw = transfer_weights(character, garment, options=RAW).dense(2)
    smooth = transfer_weights(character, garment).dense(2)
    np.testing.assert_allclose(smooth.sum(axis=1), 1)
    assert np.ptp(smooth[:, 0]) < np.ptp(raw[:, 0]) - 0.01
    assert abs(smooth[:, 0].mean() - raw[:, 0].mean()) < 0.01


def test_loose_vertices_alone_are_smoothed_longer(character):
    garment = Mesh("/G", character.bodies[0].mesh.points * 1.1, character.bodies[0].mesh.faces)
    classes = np.where(garment.points[:, 1] < -0.3, LOOSE, TIGHT)
    briefly = WeightOptions(loose_rounds=WeightOptions.tight_rounds)
    lbs = transfer_weights(character, garment, classes=classes, options=briefly).dense(2)
    longer = transfer_weights(character, garment, classes=classes).dense(2)
    np.testing.assert_array_equal(longer[classes == TIGHT], lbs[classes == TIGHT])
    assert np.abs(longer - lbs)[classes == LOOSE].max() > 0.05


def test_panels_that_meet_without_being_welded_stay_together(character):
    left, right = sheet(1.2), sheet(1.2)
    points = np.concatenate([left.points - [0.5, 0, 0], right.points + [0.5, 0, 0]])
    both = Mesh("/Panels", points, np.concatenate([left.faces, right.faces + len(left.points)]))
    weights = transfer_weights(character, both).dense(2)
    seam_left = np.flatnonzero(np.abs(both.points[:121, 0]) < 1e-9)
    seam_right = 121 + np.flatnonzero(np.abs(both.points[121:, 0]) < 1e-9)
    assert len(seam_left) == 11
    np.testing.assert_array_equal(weights[seam_left], weights[seam_right])


def test_influences_are_limited(character):
    skin = transfer_weights(character, sheet(1.2), options=WeightOptions(influences=1))
    assert skin.weights.shape == (121, 1)


def test_bodies_with_slivers_still_answer():
    flat = Mesh("/Flat", [[0.0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]])
    found = closest_on_surface(np.array([[1.9, 1.0, 0]]), flat)
    assert found.barycentric.tolist() == [[0, 0, 1]]
    np.testing.assert_allclose(found.distance, 1)


@pytest.mark.parametrize("bad", [{"tight_rounds": -1}, {"loose_rounds": -2}, {"influences": 0}])
def test_bad_options_are_named(bad):
    with pytest.raises(SsilkError, match=next(iter(bad))):
        WeightOptions(**bad)
