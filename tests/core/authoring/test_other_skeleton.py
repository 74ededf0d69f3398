# SPDX-License-Identifier: Apache-2.0
"""A garment put onto a character with another skeleton and another mesh."""

from dataclasses import replace

import igl
import numpy as np
import trimesh

from ssilk_core.authoring.bodies.fitted import fitted_body
from ssilk_core.authoring.bodies.other_skeleton import carry_onto
from ssilk_core.scene.assets import Body, Character, Mesh, Scene, Skeleton, SkinWeights
from ssilk_core.scene.kinematics import local_transforms
from ssilk_core.scene.posed_alike import alike, posed_points

from ..humanoids import PARTS, SCHEMES, humanoid


def ball(radius: float, subdivisions: int = 3, stretch=(1, 1, 1)) -> Mesh:
    """The toy's body, or one within it, with another topology."""
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return Mesh("/other/body", sphere.vertices * stretch + [0, 1.15, 0], sphere.faces)


def distances(points, mesh: Mesh):
    return np.sqrt(igl.point_mesh_squared_distance(points, mesh.points, mesh.faces.astype(np.int64))[0])


def test_a_body_is_laid_onto_the_surface_of_another(scene):
    character, onto = scene.character, ball(0.12, stretch=(1.3, 1, 0.9))
    binds = character.skeleton.bind_transforms
    found = fitted_body(character.bodies[0], character.skeleton, binds, onto)
    assert distances(character.bodies[0].mesh.points, onto).max() > 0.03
    assert distances(found.mesh.points, onto).max() < 5e-3
    within = ball(0.1)
    both = Mesh(
        "/other/body", np.concatenate([onto.points, within.points]),
        np.concatenate([onto.faces, within.faces + onto.vertex_count]),
    )  # fmt: skip
    hidden = fitted_body(character.bodies[0], character.skeleton, binds, both)
    np.testing.assert_allclose(hidden.mesh.points, found.mesh.points, atol=1e-6)


def other_character(scene, mesh: Mesh, *, longer: bool = False) -> Character:
    """The toy's figure under other names, on axes of its own; `longer` has a joint more in its spine."""
    binds, parents = np.array(scene.character.skeleton.bind_transforms), [-1, 0, 1]
    names, moved = ["a", "a/b", "a/b/c"], [0, 1]
    if longer:
        more = np.array(binds[1])
        more[1, 3] += 0.06
        binds, parents = np.concatenate([binds[:2], more[None], binds[2:]]), [-1, 0, 1, 2]
        names, moved = ["a", "a/b", "a/b/d", "a/b/d/c"], [0, 1, 2]
    turn = np.eye(4)
    turn[:3, :3] = [[0, 1, 0], [0, 0, 1], [1, 0, 0]]
    binds = binds @ turn
    skeleton = Skeleton("/other", tuple(names), parents, binds, local_transforms(binds, np.array(parents)))
    up = ((mesh.points[:, 1] - 1.03) / 0.24).clip(0, 1) * (len(moved) - 1)
    weights = (1 - np.abs(up[:, None] - np.arange(len(moved)))).clip(0, 1)
    skin = SkinWeights(mesh.path, np.tile(moved, (mesh.vertex_count, 1)), weights)
    return Character("/other", skeleton, (Body(mesh, skin),))


IMAGES = np.array([0, 1, 2])


def test_the_same_body_under_another_rig_leaves_the_garment_where_it_is(scene):
    carried = carry_onto(scene, other_character(scene, scene.character.bodies[0].mesh), IMAGES)
    np.testing.assert_allclose(carried.scene.garment.mesh.points, scene.garment.mesh.points, atol=1e-6)
    np.testing.assert_allclose(carried.scene.rig.bind_transforms, scene.rig.bind_transforms, atol=1e-6)
    np.testing.assert_array_equal(carried.scene.rig.parents, scene.rig.parents)
    for own, its in ((scene.lbs_skin, carried.scene.lbs_skin), (scene.rig.skin, carried.scene.rig.skin)):
        np.testing.assert_allclose(its.dense(5), own.dense(5), atol=0.011)  # what is little is left out
    assert carried.fit.max() < 1e-6


def test_a_garment_lies_as_far_from_a_larger_body_of_another_mesh(scene):
    onto = ball(0.16)
    carried = carry_onto(scene, other_character(scene, onto), IMAGES)
    before = distances(scene.garment.mesh.points, scene.character.bodies[0].mesh)
    after, near = distances(carried.scene.garment.mesh.points, onto), before < 0.06
    assert near.sum() > 5 and not len(carried.settled.after.vertices)
    assert (after[near] < 0.1).all() and carried.moved[near, 2].mean() < -0.02  # it hangs behind the body
    np.testing.assert_array_equal(carried.scene.classes, scene.classes)


def test_joints_of_a_longer_spine_share_a_weight_as_in_the_skin_beneath(scene):
    images = np.array([0, 1, 3])
    carried = carry_onto(scene, other_character(scene, scene.character.bodies[0].mesh, longer=True), images)
    own, its = scene.lbs_skin.dense(3), carried.scene.lbs_skin.dense(4)
    np.testing.assert_allclose(its[:, 1] + its[:, 2], own[:, 1], atol=0.03)
    high = scene.garment.mesh.points[:, 1] > 1.25
    assert (its[high, 2] > its[high, 1]).all()
    assert carried.scene.rig.parents.tolist() == [1, 4]  # of the first proxy, and the first proxy


def dressed(skeleton: Skeleton, bound: np.ndarray | None = None) -> tuple[Character, Mesh]:
    """A figure of balls around its joints, and a strip of cloth over its left arm.

    Args:
        bound: where its joints are while the balls are made; None for its bind pose.
    """
    at = skeleton.bind_transforms if bound is None else bound
    balls = [trimesh.creation.icosphere(subdivisions=1, radius=0.06) for _ in at]
    moves = skeleton.bind_transforms @ np.linalg.inv(at)
    points = np.concatenate(
        [(ball.vertices + place[:3, 3]) @ move[:3, :3].T + move[:3, 3] for ball, place, move in zip(balls, at, moves)]
    )
    count = len(balls[0].vertices)
    faces = np.concatenate([ball.faces + count * number for number, ball in enumerate(balls)])
    joints = np.repeat(np.arange(len(at)), count)[:, None]
    body = Body(Mesh("/figure/body", points, faces), SkinWeights("/figure/body", joints, np.ones(joints.shape)))
    return Character("/figure", skeleton, (body,)), body.mesh


def test_a_garment_is_put_on_in_the_pose_in_which_it_was_made(scene):
    own = humanoid(SCHEMES["cmu"], axes=1)
    arm, forearm = (PARTS.index(f"left {part}") for part in ("upper arm", "forearm"))
    character, _ = dressed(own)
    mesh, weights = scene.garment.mesh, np.zeros((scene.garment.mesh.vertex_count, own.joint_count))
    along = np.linspace(0, 1, len(weights))
    weights[:, arm], weights[:, forearm] = 1 - along, along
    middle = own.bind_transforms[[arm, forearm], :3, 3].mean(axis=0)
    points = mesh.points - mesh.points.mean(axis=0) + middle + [0, 0.15, -0.1]
    skin = SkinWeights.from_dense("/strip", weights)
    rig = replace(scene.rig, joint_names=(), parents=np.zeros(0, int), bind_transforms=np.zeros((0, 4, 4)), skin=skin)
    garment = replace(scene.garment, mesh=replace(mesh, points=points), skin=skin)
    worn = Scene(character, garment, rig)
    images = np.arange(own.joint_count)
    for arms, turn in ((0, 0), (0, 180), (80, 0)):
        names = humanoid(SCHEMES["unreal"], arms=arms, turn=turn, axes=2)
        other, _ = dressed(names, alike(own, names, images).transforms)
        carried = carry_onto(worn, other, images)
        there = carried.scene.garment
        np.testing.assert_allclose(
            posed_points(there.mesh.points, there.skin, carried.posed, names), points, atol=2e-3
        )
        # At its upper end the cloth lies by the arm alone, and turns with it.
        back = names.bind_transforms[arm] @ np.linalg.inv(carried.posed.transforms[arm])
        np.testing.assert_allclose(there.mesh.points[0], back[:3, :3] @ points[0] + back[:3, 3], atol=2e-3)
