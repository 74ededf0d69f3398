# SPDX-License-Identifier: Apache-2.0
"""Weights fitted to the skin: a sleeve on a bent arm, whole and repeatable weights, points of the simplex."""

import numpy as np
import pytest

from ssilk_core.authoring.setup.binding import LARGEST_TURN, bind_to_skin, sample_poses, to_simplex
from ssilk_core.authoring.setup.weights import transfer_weights
from ssilk_core.scene.assets import PINNED, TIGHT, Body, Character, Floats, Mesh, Skeleton, SkinWeights
from ssilk_core.scene.kinematics import matrix_from_quaternion, rigid, skin_points

RADIUS, GAP = 0.05, 0.006  # [m] of the tube, and of the sleeve above it
RNG = np.random.default_rng(2)


def tube(radius: float, length: float, step: float, sides: int) -> Mesh:
    """Return an open tube along x, its normals outwards."""
    along = np.linspace(-length / 2, length / 2, round(length / step) + 1)
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack([np.zeros(sides), radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    points = (ring + along[:, None, None] * [1, 0, 0]).reshape(-1, 3)
    a = (sides * np.arange(len(along) - 1)[:, None] + np.arange(sides)).ravel()
    b = (sides * np.arange(len(along) - 1)[:, None] + (np.arange(sides) + 1) % sides).ravel()
    return Mesh(
        "/Tube", points, np.concatenate([np.stack([a, b, a + sides], 1), np.stack([b, b + sides, a + sides], 1)])
    )


@pytest.fixture(scope="module")
def arm() -> Character:
    """A coarse tube of two bones that meet at the origin, where one ring of triangles takes all of the bend."""
    mesh = tube(RADIUS, 0.44, 0.04, 16)
    second = (mesh.points[:, 0] > 0).astype(float)
    skin = SkinWeights("/Arm", np.tile([0, 1], (len(second), 1)), np.stack([1 - second, second], axis=1))
    eye = np.tile(np.eye(4), (2, 1, 1))
    return Character("/Arm", Skeleton("/Rig", ("Up", "Up/Low"), [-1, 0], eye, eye), (Body(mesh, skin),))


@pytest.fixture(scope="module")
def sleeve() -> Mesh:
    return tube(RADIUS + GAP, 0.3, 0.03, 16)


def clearance(arm: Character, sleeve: Mesh, skin: SkinWeights, degrees: float) -> Floats:
    """Return the signed distances [m] of the sleeve's free part from the arm, whose second bone is turned about z.

    On the inner side the arm passes through itself where y > |x| / tan(angle / 2): nothing is free there.
    """
    import igl

    half = np.radians(degrees) / 2
    turn = matrix_from_quaternion(np.array([np.cos(half), 0, 0, np.sin(half)]))
    matrices = rigid(np.stack([np.eye(3), turn]), np.zeros((2, 3)))[None]
    body = arm.bodies[0]
    posed = skin_points(body.mesh.points, body.skin, matrices)[0]
    x = skin_points(sleeve.points, skin, matrices)[0]
    by_normals = igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
    distance = np.asarray(igl.signed_distance(x, posed, body.mesh.faces, sign_type=by_normals)[0])
    return distance[sleeve.points[:, 1] * np.tan(half) <= np.abs(sleeve.points[:, 0])]


@pytest.mark.parametrize("degrees", [60, 90, -90])
def test_bound_sleeve_stays_outside_a_bent_arm_where_transferred_weights_enter_it(arm, sleeve, degrees):
    transferred = transfer_weights(arm, sleeve)
    bound = transfer_weights(arm, sleeve, classes=np.full(sleeve.vertex_count, TIGHT))
    assert clearance(arm, sleeve, transferred, degrees).min() < -GAP
    assert clearance(arm, sleeve, bound, degrees).min() > 0


def test_cloth_far_from_the_bend_follows_one_bone(arm, sleeve):
    weights = transfer_weights(arm, sleeve, classes=np.full(sleeve.vertex_count, PINNED)).dense(2)
    np.testing.assert_allclose(weights[sleeve.points[:, 0] < -0.1, 0], 1, atol=0.02)
    np.testing.assert_allclose(weights[sleeve.points[:, 0] > 0.1, 1], 1, atol=0.02)


def test_binding_is_repeatable_and_its_weights_are_few_and_whole():
    count, joints = 60, 6
    body = tube(RADIUS, 0.44, 0.04, 16)
    weights = RNG.dirichlet(np.full(joints, 0.3), body.vertex_count)
    eye = np.tile(np.eye(4), (joints, 1, 1))
    eye[:, 0, 3] = np.linspace(-0.2, 0.2, joints)
    skeleton = Skeleton("/Rig", tuple("ABCDEF"), np.arange(-1, joints - 1), eye, eye)
    character = Character("/Arm", skeleton, (Body(body, SkinWeights.from_dense("/Arm", weights)),))
    points = tube(RADIUS + GAP, 0.3, 0.03, 16).points[:count]
    pairs = np.stack([np.arange(count - 1), np.arange(1, count)], axis=1)
    given = character, points, np.full(count, 1e-4), pairs, RNG.dirichlet(np.ones(joints), count), 3
    found = bind_to_skin(*given)
    np.testing.assert_array_equal(found, bind_to_skin(*given))
    assert found.min() >= 0 and np.count_nonzero(found, axis=1).max() == 3
    np.testing.assert_allclose(found.sum(axis=1), 1, atol=1e-9)


def test_sampled_poses_keep_bones_and_turn_every_joint(arm):
    poses = sample_poses(arm.skeleton, 50)
    cosine = (np.trace(poses[:, 0, :3, :3], axis1=1, axis2=2) - 1) / 2
    assert cosine.min() > np.cos(LARGEST_TURN) - 1e-9 and cosine.min() < 0.6
    np.testing.assert_allclose(poses[:, :, :3, 3], 0, atol=1e-12)
    relative = poses[:, 0, :3, :3].transpose(0, 2, 1) @ poses[:, 1, :3, :3]
    assert (np.trace(relative, axis1=1, axis2=2) < 3 - 1e-4).all()


def test_points_of_the_simplex_are_the_nearest_ones():
    values = RNG.normal(size=(200, 5))
    found = to_simplex(values)
    np.testing.assert_allclose(found.sum(axis=1), 1, atol=1e-12)
    assert found.min() == 0
    # The nearest point of a convex set: no other point makes an acute angle with the way to it.
    others = RNG.dirichlet(np.ones(5), 300)
    assert np.einsum("vk,vok->vo", values - found, others[None] - found[:, None]).max() < 1e-12
    np.testing.assert_allclose(to_simplex(np.array([[0.2, -np.inf, 0.4]])), [[0.4, 0, 0.6]])
