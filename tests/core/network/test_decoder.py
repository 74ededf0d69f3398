# SPDX-License-Identifier: Apache-2.0
"""Proxy kinematics, blendshapes and skinning of the decoder against float64 references."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ssilk_core.network.descriptors import six_d
from ssilk_core.network.model.decoder import compose, limited, rotation_from_six_d
from ssilk_core.network.runtime import kinematics
from ssilk_core.scene.assets import LOOSE, PINNED, GarmentPose
from ssilk_core.scene.kinematics import (
    combined_transforms,
    deform,
    motion_transforms,
    skin_points,
    skinning_matrices,
    world_transforms,
)

SHAPES_AND_PROXIES = pytest.mark.parametrize("shapes, proxies", [(4, 2), (0, 2), (4, 0), (0, 0)])


def skinning(scene, motion) -> np.ndarray:
    skeleton = scene.character.skeleton
    return skinning_matrices(motion_transforms(motion, skeleton.parents), skeleton.bind_transforms)


def as_tensor(matrices: np.ndarray) -> torch.Tensor:
    return torch.tensor(matrices[..., :3, :].transpose(1, 2, 3, 0), dtype=torch.float32)


def latents(model, frames: int) -> torch.Tensor:
    return 2 * torch.randn(frames, model.config.latent, generator=torch.Generator().manual_seed(1))


def test_six_d_round_trips_scipy_rotations():
    matrices = Rotation.random(200, random_state=0).as_matrix()
    values = torch.tensor(six_d(matrices)).T[None]
    np.testing.assert_allclose(rotation_from_six_d(values)[0].permute(2, 0, 1), matrices, atol=1e-12)


def test_any_six_numbers_become_a_rotation_with_the_first_axis_kept():
    values = torch.randn(300, 6, generator=torch.Generator().manual_seed(0)).double()
    matrices = rotation_from_six_d(values.T[None])[0].permute(2, 0, 1).numpy()
    np.testing.assert_allclose(matrices @ matrices.transpose(0, 2, 1), np.tile(np.eye(3), (300, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(matrices), 1)
    first = values[:, :3].numpy()
    np.testing.assert_allclose(matrices[:, :, 0], first / np.linalg.norm(first, axis=1, keepdims=True), atol=1e-12)
    second = values[:, 3:].numpy()
    assert (np.sum(matrices[:, :, 1] * second, axis=1) > 0).all()
    assert np.abs(np.sum(matrices[:, :, 2] * second, axis=1)).max() < 1e-12


def test_a_proxy_moves_no_further_than_the_garment_is_long(scene, toy_model):
    model = toy_model(scene, scale=5.0, translations=True)
    far = model.pose(100 * torch.randn(50, 8))[1][:, :, 3].norm(dim=1)
    assert far.max() <= 1.0001 * scene.garment.mesh.diagonal < 1.001 * far.max()
    near, any_size = 0.1 * torch.rand(2, 3, 5), 3 * torch.rand(2, 3, 5)
    assert torch.equal(limited(near, 1.0), near)
    np.testing.assert_allclose(limited(any_size, 1.0), kinematics.limited(any_size.numpy(), np.float32(1)), atol=1e-6)


def test_six_d_of_zeros_has_a_finite_gradient():
    values = torch.zeros(1, 6, 1, requires_grad=True)
    rotation_from_six_d(values).sum().backward()
    assert torch.isfinite(values.grad).all()


def test_compose_is_the_product_of_affine_transforms():
    left, right = (torch.randn(5, 3, 4, 2, generator=torch.Generator().manual_seed(s)) for s in (0, 1))
    bottom = torch.tensor([0.0, 0, 0, 1])[None, None, :, None].expand(5, 1, 4, 2)
    full = [torch.cat([m, bottom], 1).permute(0, 3, 1, 2) for m in (left, right)]
    expected = (full[0] @ full[1])[:, :, :3].permute(0, 2, 3, 1)
    np.testing.assert_allclose(compose(left, right), expected, atol=1e-5)


@pytest.mark.parametrize("translations", [False, True], ids=["turning", "moving"])
@pytest.mark.parametrize("shuffled", [False, True], ids=["chain", "side by side"])
def test_forward_kinematics_equals_local_transforms_composed(
    toy_scene, toy_motion, toy_model, shuffled, translations
):
    scene = toy_scene(shuffled=shuffled)
    model, motion = toy_model(scene, translations=translations), toy_motion(scene, 6)
    activation, transforms = model.pose(latents(model, 6))
    assert bool(transforms[:, :, 3].abs().max() > 0.01) == translations
    with torch.no_grad():
        found = model.decoder.proxy_matrices(transforms, as_tensor(skinning(scene, motion)))
    pose = GarmentPose(0, *model.file_pose(activation, transforms))
    world = combined_transforms(model.deformer(), motion, pose)
    expected = skinning_matrices(world, scene.bind_transforms)[:, :, :3].transpose(1, 2, 3, 0)
    np.testing.assert_allclose(found, expected, atol=2e-6)
    assert np.abs(expected[3:] - skinning(scene, motion)[:, 1, :3].transpose(1, 2, 0)[None]).max() > 0.05


def test_a_reordered_rig_is_decoded_parents_first(toy_scene, toy_model):
    """Proxies of different depths may come in any order that keeps parents first."""
    from dataclasses import replace

    scene = toy_scene()
    rig = scene.rig
    twice = replace(
        rig,
        joint_names=("A", "A/B", "C", "C/D"),
        parents=np.array([1, 3, 0, 5]),
        bind_transforms=np.concatenate([rig.bind_transforms, rig.bind_transforms[::-1]]),
    )
    scene = replace(scene, rig=twice)
    model = toy_model(scene)
    turns = Rotation.random(4, random_state=3).as_matrix()
    moved = np.random.default_rng(4).normal(size=(4, 3))
    transforms = torch.tensor(np.concatenate([turns, moved[:, :, None]], axis=2), dtype=torch.float32)[..., None]
    still = torch.eye(4)[None, :3, :, None].expand(3, 3, 4, 1)
    found = model.decoder.proxy_matrices(transforms, still)[3:, :, :, 0].numpy()
    pivots = twice.bind_transforms[:, :3, 3]
    own = np.tile(np.eye(4), (4, 1, 1))
    own[:, :3, :3], own[:, :3, 3] = turns, pivots - np.einsum("pab,pb->pa", turns, pivots) + moved
    expected = np.stack([own[0], own[0] @ own[1], own[2], own[2] @ own[3]])
    np.testing.assert_allclose(found, expected[:, :3], atol=1e-6)


@SHAPES_AND_PROXIES
@pytest.mark.parametrize("translations", [False, True], ids=["turning", "moving"])
def test_vertices_equal_what_a_file_reader_deforms(toy_scene, toy_motion, toy_model, shapes, proxies, translations):
    scene = toy_scene(proxies=proxies)
    model, motion = toy_model(scene, shapes=shapes, translations=translations), toy_motion(scene, 9)
    z = latents(model, 9)
    with torch.no_grad():
        found = model.vertices(z, as_tensor(skinning(scene, motion))).permute(2, 0, 1)
        pose = GarmentPose(0, *model.file_pose(*model.pose(z)))
    assert pose.weights.shape == (9, shapes + 1 if shapes else 0) and pose.rotations.shape == (9, proxies, 4)
    assert pose.weights.min(initial=0) >= 0 and pose.weights.max(initial=0) <= 1
    np.testing.assert_allclose(found, deform(model.deformer(), motion, pose), atol=5e-6)


def test_rest_is_the_middle_of_the_range_of_every_shape(scene, toy_motion, toy_model):
    model = toy_model(scene)
    at_rest = torch.eye(3, 4)[None, ..., None].expand(2, 3, 4, 1)
    rotations, weights, _ = model.file_pose(torch.zeros(4, 1), at_rest)
    np.testing.assert_allclose(weights, [[0.5, 0.5, 0.5, 0.5, 1.0]])
    shapes = model.deformer().shapes
    np.testing.assert_allclose(np.einsum("fk,kvc->fvc", weights, shapes), 0, atol=1e-7)
    local = np.tile(np.eye(4), (1, 2, 1, 1))
    local[..., :3, :3] = (
        Rotation.from_quat(rotations[..., [1, 2, 3, 0]].reshape(-1, 4)).as_matrix().reshape(1, 2, 3, 3)
    )
    bind = scene.bind_transforms
    world = world_transforms(local, np.array([-1, 0]))[..., :3, :3]
    np.testing.assert_allclose(bind[1, :3, :3] @ world[0], bind[3:, :3, :3], atol=1e-12)


def test_weights_stay_on_their_support_and_sum_to_one(scene, toy_model):
    model = toy_model(scene)
    with torch.no_grad():
        weights = model.decoder.skin_weights().double().numpy()
    dense = np.zeros((60, 5))
    dense[:, model.decoder.used.numpy()] = weights
    initial = scene.rig.skin.dense(5)
    np.testing.assert_allclose(dense.sum(1), 1, atol=1e-6)
    np.testing.assert_array_equal(dense > 0, initial > 0)
    pinned = scene.classes == PINNED
    np.testing.assert_allclose(dense[pinned], initial[pinned], atol=1e-7)
    moved = np.abs(dense - initial).max(axis=1)
    several = (initial > 0).sum(1) > 1
    assert (moved[several & ~pinned] > 1e-3).mean() > 0.9
    assert (dense[scene.classes == LOOSE][:, 3:].sum(1) > 0.99).all()


def test_untrained_weights_are_the_rigs(scene, toy_model):
    decoder = toy_model(scene).decoder
    with torch.no_grad():
        decoder.skin_offset.zero_()
        dense = decoder.skin_weights().numpy()
    np.testing.assert_allclose(dense, scene.rig.skin.dense(5)[:, decoder.used.numpy()], atol=1e-7)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_pinned_vertices_follow_plain_skinning_whatever_the_network_says(scene, toy_motion, toy_model, seed):
    model, motion = toy_model(scene, seed=seed, scale=3.0), toy_motion(scene, 4)
    matrices = skinning(scene, motion)
    pinned = scene.classes == PINNED
    with torch.no_grad():
        found = model.vertices(50 * latents(model, 4), as_tensor(matrices)).permute(2, 0, 1)
    lbs = skin_points(scene.garment.mesh.points, scene.lbs_skin, matrices)
    np.testing.assert_allclose(found[:, pinned], lbs[:, pinned], atol=1e-6)
    assert np.abs(found.numpy() - lbs)[:, ~pinned].max() > 0.05
    assert (model.deformer().shapes[:, pinned] == 0).all()


@SHAPES_AND_PROXIES
def test_counts_of_zero_cost_no_parameters(toy_scene, toy_model, shapes, proxies):
    scene = toy_scene(proxies=proxies)
    model = toy_model(scene, shapes=shapes)
    free = int((scene.classes != PINNED).sum())
    assert model.decoder.shapes.numel() == free * 3 * shapes
    assert sum(p.numel() for p in model.output[-1].parameters()) == 17 * (shapes + 6 * proxies)
    assert model.deformer().shape_count == (shapes + 1 if shapes else 0)


def test_gradients_reach_every_parameter_of_the_decoder(scene, toy_motion, toy_model):
    model = toy_model(scene)
    x = model.vertices(latents(model, 3), as_tensor(skinning(scene, toy_motion(scene, 3))))
    (x**2).sum().backward()
    for name, value in model.named_parameters():
        if name.startswith(("decoder.", "output.")):
            assert value.grad is not None and value.grad.abs().max() > 0, name
