# SPDX-License-Identifier: Apache-2.0
"""The stage that the extension writes, read by ssilk's own readers, without Blender."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from blender_addon.contract.arrays import Dressed, Joints, Shape, dense, influences
from blender_addon.contract.names import identifiers, joint_paths

TO_Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


def test_names_become_unique_identifiers():
    assert identifiers(["Arm.L", "Arm_L", "Ärmel", "", "2nd", "Skeleton"], ["Skeleton"]) == [
        "Arm_L", "Arm_L_2", "_rmel", "_", "_2nd", "Skeleton_2",
    ]  # fmt: skip


def test_joint_paths_spell_parents():
    assert joint_paths(["a:Hips", "Leg.L", "Leg_L"], [-1, 0, 1]) == ["a_Hips", "a_Hips/Leg_L", "a_Hips/Leg_L/Leg_L_2"]


def test_influences_and_dense_weights_are_each_others_inverse():
    weights = np.array([[0, 0.25, 0.75], [1, 0, 0], [0, 0, 0]], dtype=np.float32)
    indices, values = influences(weights)
    assert indices.tolist() == [[2, 1], [0, 0], [0, 0]]
    assert np.array_equal(dense(indices, values, 3), weights)


def turned(angle: float, place: tuple[float, float, float]) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    matrix[:3, 3] = place
    return matrix


def shape(name: str, weights: np.ndarray | None, *, inside_out: bool = False) -> Shape:
    points = np.array([[0.0, 0, 1], [1, 0, 1], [1, 1, 1.5], [0, 1, 1.5], [2, 2, 2]])
    counts, corners = np.array([4, 3]), np.array([0, 1, 2, 3, 1, 4, 2])
    return Shape(name, points, counts, corners, inside_out, points[corners, :2] / 2, weights)


@pytest.fixture
def dressed() -> Dressed:
    joints = Joints(
        names=("Hips", "Spine.001", "Über-Spine", "Skirt proxy"),
        parents=np.array([-1, 0, 1, 0]),
        binds=np.array([turned(0.3 * joint, (0.1 * joint, 0.2, 0.8 + joint / 3)) for joint in range(4)]),
        proxy_count=1,
    )
    weights = np.random.default_rng(1).dirichlet(np.ones(4), 5).astype(np.float32)
    plain = np.eye(3, dtype=np.float32)[[0, 1, 2, 1, 0]]
    body = np.pad(plain, ((0, 0), (0, 1)))
    return Dressed(
        0.01, joints, (shape("Body.001", body, inside_out=True),), shape("Ärmel", weights), np.array([0, 1, 2, 2, 1]),
        plain,
    )  # fmt: skip


def read_back(dressed, tmp_path):
    read_scene = pytest.importorskip("ssilk_usd.read_scene", reason="ssilk[usd] is not installed here").read_scene
    from blender_addon.contract.write import write_stage

    prims = write_stage(dressed, tmp_path / "out.usdc")
    return prims, *read_scene(tmp_path / "out.usdc")


def test_ssilk_reads_what_was_written(dressed, tmp_path):
    prims, character, garment, rig = read_back(dressed, tmp_path)
    assert prims == {"Ärmel": "/Character/_rmel", "Body.001": "/Character/Body_001"}
    skeleton, scale = character.skeleton, 0.01
    assert skeleton.joint_names == ("Hips", "Hips/Spine_001", "Hips/Spine_001/_ber_Spine")
    places = dressed.joints.binds[:, :3, 3] @ TO_Y_UP.T * scale
    turns = TO_Y_UP @ dressed.joints.binds[:, :3, :3]
    for own, wanted in ((skeleton.bind_transforms, slice(0, 3)), (rig.bind_transforms, slice(3, 4))):
        np.testing.assert_allclose(own[:, :3, 3], places[wanted], atol=1e-9)
        np.testing.assert_allclose(own[:, :3, :3], turns[wanted], atol=1e-9)
    np.testing.assert_allclose(garment.mesh.points, dressed.garment.points @ TO_Y_UP.T * scale, atol=1e-9)
    assert garment.classes.tolist() == [0, 1, 2, 2, 1]
    np.testing.assert_allclose(garment.skin.dense(3), dressed.plain, atol=1e-6)
    assert (rig.joint_names, rig.parents.tolist()) == (("Hips/Skirt_proxy",), [0])
    np.testing.assert_allclose(rig.skin.dense(4), dressed.garment.weights, atol=1e-6)
    np.testing.assert_allclose(garment.mesh.uvs, dressed.garment.uvs, atol=1e-6)
    (body,) = character.bodies
    np.testing.assert_allclose(body.skin.dense(3), dressed.bodies[0].weights[:, :3], atol=1e-6)


def test_faces_of_a_mirrored_object_are_turned_over(dressed, tmp_path):
    _, character, garment, _ = read_back(dressed, tmp_path)
    (body,) = character.bodies
    normals = [normal(mesh.points, mesh.faces[-1]) for mesh in (body.mesh, garment.mesh)]
    np.testing.assert_allclose(normals[0], -normals[1], atol=1e-12)


def normal(points, face):
    a, b, c = points[face]
    return np.cross(b - a, c - a)


def test_what_is_missing_is_left_out(dressed, tmp_path):
    joints = replace(
        dressed.joints, names=dressed.joints.names[:3], parents=np.array([-1, 0, 1]), binds=dressed.joints.binds[:3],
        proxy_count=0,
    )  # fmt: skip
    body = replace(dressed.bodies[0], weights=dressed.bodies[0].weights[:, :3])
    bare = replace(dressed.garment, weights=None, uvs=None)
    plain = replace(dressed, joints=joints, bodies=(body,), garment=bare, classes=None, plain=None)
    _, _, garment, rig = read_back(plain, tmp_path)
    assert (garment.skin, garment.classes, garment.mesh.uvs, rig) == (None, None, None, None)
