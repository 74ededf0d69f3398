# SPDX-License-Identifier: Apache-2.0
"""Proxies that are held each by itself, against the definition, vertex by vertex."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ssilk_core.delivery.bake.direction import DirectedPoses, Direction
from ssilk_core.scene.assets import Deformer, GarmentPose, Motion, SkinWeights
from ssilk_core.scene.held import HeldGarment
from ssilk_core.scene.held_parts import HeldParts, PartShapes, hand_pose, shares_of_group
from ssilk_core.scene.kinematics import (
    combined_transforms,
    deform,
    motion_transforms,
    quaternion_from_matrix,
    skinning_matrices,
)

FRAMES = 5


@pytest.fixture(scope="module")
def deformer(scene, toy_model) -> Deformer:
    """Proxies of which the last hangs from the first, and vertices that follow several."""
    parents = scene.rig.parents.copy()
    parents[-1] = scene.character.skeleton.joint_count
    scene = replace(scene, rig=replace(scene.rig, parents=parents))
    found, rng = toy_model(scene, shapes=3).deformer(), np.random.default_rng(3)
    dense = found.skin.dense(len(scene.joint_names)) * rng.uniform(0.5, 1.5, (1, len(scene.joint_names)))
    dense[:, -2:] += 0.2
    skin = SkinWeights.from_dense(found.skin.path, dense / dense.sum(axis=1, keepdims=True))
    free = 0.05 * rng.normal(size=(3, scene.garment.mesh.vertex_count, 3))
    return replace(found, skin=skin, shapes=np.concatenate([free, -0.5 * free.sum(axis=0, keepdims=True)]))


@pytest.fixture
def network(deformer) -> GarmentPose:
    rng, proxies = np.random.default_rng(5), deformer.scene.rig.proxy_count
    turns = rng.normal(size=(FRAMES, proxies, 4)) * 0.3 + [1, 0, 0, 0]
    turns /= np.linalg.norm(turns, axis=-1, keepdims=True)
    weights = np.concatenate([rng.uniform(0, 1, (FRAMES, 3)), np.ones((FRAMES, 1))], axis=1)
    return GarmentPose(0, turns, weights, rng.normal(scale=0.1, size=(FRAMES, proxies, 3)))


def shares(proxies: int) -> tuple[np.ndarray, np.ndarray]:
    """Curves of three kinds, two of which overlap."""
    skinned, posed = np.zeros((FRAMES, proxies)), np.zeros((FRAMES, proxies))
    skinned[:, 0] = np.linspace(0.2, 1, FRAMES)
    skinned[:, -1] = np.linspace(0.6, 0, FRAMES)
    posed[:, -1] = np.linspace(0, 0.7, FRAMES)
    return skinned, posed


def as_defined(deformer: Deformer, motion: Motion, network: GarmentPose, parts: HeldParts, whole) -> np.ndarray:
    """Vertices in the world, (F, V, 3) [m]: between the network's, skinning's and the hand's proxies."""
    held, scene = HeldGarment(deformer), deformer.scene
    pose, _ = held.pose(motion)
    count, dense = scene.character.skeleton.joint_count, deformer.skin.dense(len(scene.joint_names))
    own, skinned = (combined_transforms(deformer, motion, each) for each in (network, pose))
    found = np.zeros((FRAMES, len(dense), 3))
    for frame in range(FRAMES):
        world, free = own[frame].copy(), np.zeros(scene.rig.proxy_count)
        for proxy in range(scene.rig.proxy_count):
            above = count + proxy
            while above >= count:
                above = int(scene.parents[above])
            hand = own[frame, above] @ parts.hand[frame, proxy]
            a = 1 - whole[frame] * (1 - parts.skinned[frame, proxy])
            for target, share in ((skinned[frame, count + proxy], a), (hand, parts.posed[frame, proxy])):
                now = world[count + proxy]
                way = Rotation.from_matrix(target[:3, :3] @ now[:3, :3].T).as_rotvec()
                now[:3, :3] = Rotation.from_rotvec(share * way).as_matrix() @ now[:3, :3]
                now[:3, 3] += share * (target[:3, 3] - now[:3, 3])
            free[proxy] = (1 - a) * (1 - parts.posed[frame, proxy])
        matrices = skinning_matrices(world[None], scene.bind_transforms)[0]
        for vertex, row in enumerate(dense):
            follow = row[count:]
            share = follow @ free / follow.sum() if follow.sum() else free.mean()
            weights = held.weights + share * (network.weights[frame] - held.weights)
            point = scene.garment.mesh.points[vertex] + weights @ deformer.shapes[:, vertex]
            found[frame, vertex] = (row @ (matrices @ [*point, 1]))[:3]
    return found


@pytest.mark.parametrize("whole", [np.ones(FRAMES), np.linspace(1, 0.3, FRAMES)], ids=["alone", "and the garment"])
def test_proxies_are_between_the_network_and_what_holds_them(deformer, network, toy_motion, whole):
    scene, motion = deformer.scene, toy_motion(deformer.scene, FRAMES, speed=3)
    rng, (skinned, posed) = np.random.default_rng(7), shares(scene.rig.proxy_count)
    turns = Rotation.from_rotvec(rng.normal(scale=0.5, size=(FRAMES * scene.rig.proxy_count, 3))).as_matrix()
    hand = np.tile(np.eye(4), (FRAMES, scene.rig.proxy_count, 1, 1))
    hand[..., :3, :3], hand[..., :3, 3] = turns.reshape(FRAMES, -1, 3, 3), rng.normal(size=(*skinned.shape, 3))
    parts = HeldParts(skinned, posed, hand)
    direction = Direction(whole, 1, motion, 0, parts).of(deformer)
    directed = DirectedPoses(direction, deformer, lambda first, stop, step: iter([network.part(slice(first, stop))]))
    pose = GarmentPose.joined(list(directed.poses(0, FRAMES)))
    assert pose.weights.min() >= 0 and pose.weights.max() <= 1  # importers clamp others
    larger = replace(deformer, shapes=np.concatenate([deformer.shapes, direction.shapes.offsets]))
    found = deform(larger, motion, pose)
    np.testing.assert_allclose(found, as_defined(deformer, motion, network, parts, whole), atol=2e-6)


def test_curves_that_are_alike_share_their_shapes(deformer):
    """Four proxies and more, of which one is free, two are held alike, and the others half as far."""
    proxies, t = deformer.scene.rig.proxy_count, np.linspace(0, 1, FRAMES)[:, None]
    free = 1 - t * np.where(np.arange(proxies) < 2, 1, 0.5)
    free[:, 0] = 1
    found = PartShapes.of(deformer, free, np.ones(FRAMES))
    assert len(found.offsets) == deformer.shape_count
    assert len(PartShapes.of(deformer, np.ones((FRAMES, proxies)), np.ones(FRAMES)).offsets) == 1


def test_a_pose_by_hand_stays_with_the_body_and_not_with_proxies_above(deformer, network, toy_motion):
    """What a motion of all joints has of proxies is what it is from the character's joints."""
    scene, motion = deformer.scene, toy_motion(deformer.scene, FRAMES)
    assert network.translations is not None
    whole = replace(
        motion,
        rotations=np.concatenate([motion.rotations, network.rotations], axis=1),
        translations=np.concatenate([motion.translations, network.translations], axis=1),
    )
    found, world = hand_pose(scene, whole), motion_transforms(whole, scene.parents)
    above = int(scene.parents[scene.character.skeleton.joint_count])
    np.testing.assert_allclose(world[:, above] @ found[:, -1], world[:, -1], atol=1e-12)
    np.testing.assert_allclose(
        np.abs((quaternion_from_matrix(found[:, 0, :3, :3]) * network.rotations[:, 0]).sum(-1)), 1, atol=1e-12
    )


def test_a_group_holds_proxies_by_the_vertices_that_follow_them(deformer):
    scene, every = deformer.scene, np.arange(deformer.scene.garment.mesh.vertex_count)
    np.testing.assert_array_equal(shares_of_group(deformer, every), 1)
    np.testing.assert_array_equal(shares_of_group(deformer, every[:0]), 0)
    half = shares_of_group(deformer, every[::2])
    assert ((half > 0.2) & (half < 0.8)).any() and len(half) == scene.rig.proxy_count
