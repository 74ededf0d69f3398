# SPDX-License-Identifier: Apache-2.0
"""The whole network: what it starts as, what a file stores of it, and which joints it sees."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from ssilk_core.network.descriptors import model_joints
from ssilk_core.network.model.network import GarmentModel, mlp
from ssilk_core.network.parameters import descriptor_sizes, parameter_shapes
from ssilk_core.network.schemes import SCHEMES
from ssilk_core.network.settings import ModelConfig
from ssilk_core.scene.assets import GarmentPose, SkinWeights


def fresh(scene, **options) -> GarmentModel:
    return GarmentModel(scene, ModelConfig(latent=8, widths=(16,), shapes=4, **options), np.arange(3), seed=1)


def test_mlp_has_the_layers_asked_for_and_a_quiet_last_one():
    network = mlp(5, (7, 9), 3, torch.Generator().manual_seed(0), 0.0)
    assert [tuple(layer.weight.shape) for layer in network if hasattr(layer, "weight")] == [(7, 5), (9, 7), (3, 9)]
    assert network(torch.randn(4, 5)).abs().max() == 0


def test_training_starts_from_the_spring_alone_and_almost_from_lbs(scene):
    model = fresh(scene, latent_bound=0.0, max_latent_step=0.0)
    before, now, rest = torch.randn(3, 6, 8, generator=torch.Generator().manual_seed(0))
    seen = torch.randn(6, 3 * model.feedback.count, generator=torch.Generator().manual_seed(2))
    size = model.stepper[0].in_features - 24 - seen.shape[1]
    pose = torch.randn(6, size, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        stepped, own = model.step(before, now, rest, pose, seen), model.integrator
        forward = now + own.beta * (now - before)
        spring = model.config.stiffness * torch.sigmoid(own.share) * (rest - forward)
        np.testing.assert_allclose(stepped, forward + spring, atol=1e-6)
        activation, transforms = model.pose(now)
    assert activation.abs().max() < 0.1
    np.testing.assert_allclose(transforms, torch.eye(3, 4)[None, ..., None].expand(2, 3, 4, 6), atol=0.1)


def test_the_seed_alone_decides_the_parameters(scene):
    torch.manual_seed(5)
    first = fresh(scene).state_dict()
    torch.manual_seed(6)
    second = fresh(scene).state_dict()
    assert all(torch.equal(first[name], second[name]) for name in first)
    other = GarmentModel(scene, ModelConfig(latent=8, widths=(16,), shapes=4), np.arange(3), seed=2).state_dict()
    assert not torch.equal(first["initialiser.0.weight"], other["initialiser.0.weight"])


@pytest.mark.parametrize("scheme", SCHEMES)
def test_every_scheme_builds_and_steps(scene, scheme):
    model = fresh(scene, scheme=scheme)
    static = torch.randn(5, model.initialiser[0].in_features)
    pose = torch.randn(5, sum(descriptor_sizes(scene, model.joints, model.config)))
    rest = model.initial(static)
    assert model.step(rest, rest, rest, pose, torch.randn(5, 3 * model.feedback.count)).shape == (5, 8)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_rolling_windows_is_stepping_one_frame_after_the_other(scene, toy_model, toy_body, scheme):
    model = toy_model(scene, scheme=scheme)
    pose = torch.randn(
        6, 3, sum(descriptor_sizes(scene, model.joints, model.config)), generator=torch.Generator().manual_seed(1)
    )
    rest = model.initial(pose[..., : model.initialiser[0].in_features].flatten(0, 1)).unflatten(0, (6, 3))
    states = [rest[0], rest[0] + 0.1]
    body = toy_body(scene, 8, 3)
    rolled = model.roll(states, rest, pose, body)
    for frame, (still, seen) in enumerate(zip(rest, pose)):
        cloth = model.seen_from(states[-2], states[-1], body[frame : frame + 3])
        states.append(model.step(states[-2], states[-1], still, seen, cloth))
    torch.testing.assert_close(torch.stack(rolled), torch.stack(states), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("translations", [False, True])
def test_network_pose_inverts_file_pose(scene, toy_model, translations):
    model = toy_model(scene, translations=translations)
    with torch.no_grad():
        activation, transforms = model.pose(torch.randn(20, 8, generator=torch.Generator().manual_seed(2)))
        back = model.network_pose(GarmentPose(0, *model.file_pose(activation, transforms)))
    np.testing.assert_allclose(back[0], activation, atol=1e-6)
    np.testing.assert_allclose(back[1], transforms, atol=1e-6)


@pytest.mark.parametrize("shapes, proxies", [(0, 2), (4, 0), (0, 0)])
def test_network_pose_inverts_file_pose_without_shapes_or_proxies(toy_scene, toy_model, shapes, proxies):
    model = toy_model(toy_scene(proxies=proxies), shapes=shapes)
    with torch.no_grad():
        activation, transforms = model.pose(torch.randn(3, 8))
        back = model.network_pose(GarmentPose(0, *model.file_pose(activation, transforms)))
    assert back[0].shape == (shapes, 3) and back[1].shape == (proxies, 3, 4, 3)
    np.testing.assert_allclose(back[0], activation, atol=1e-6)


def test_file_weights_and_quaternions_are_valid_even_when_saturated(scene, toy_model):
    model = toy_model(scene, scale=5.0)
    with torch.no_grad():
        rotations, weights, moved = model.file_pose(*model.pose(100 * torch.randn(50, 8)))
    assert weights.min() >= 0 and weights.max() <= 1 and (weights[:, -1] == 1).all()
    assert weights[:, :-1].min() < 1e-6 and weights[:, :-1].max() > 1 - 1e-6
    np.testing.assert_allclose(np.linalg.norm(rotations, axis=-1), 1, atol=1e-12)
    assert moved is None


def test_the_network_sees_joints_that_carry_cloth_proxies_or_body_in_reach(toy_scene):
    scene = toy_scene(proxies=0)
    nothing = np.zeros(3, dtype=bool)
    assert model_joints(scene, nothing).tolist() == [0, 1]
    assert model_joints(scene, np.array([False, False, True])).tolist() == [0, 1, 2]
    hips = SkinWeights("/toy", np.zeros((60, 1)), np.ones((60, 1)))
    on_hips = replace(scene, garment=replace(scene.garment, skin=hips), rig=replace(scene.rig, skin=hips))
    assert model_joints(on_hips, nothing).tolist() == [0]
    hung = toy_scene(proxies=1)
    proxied = SkinWeights("/toy", np.full((60, 1), 3), np.ones((60, 1)))
    hung = replace(hung, garment=replace(hung.garment, skin=hips), rig=replace(hung.rig, skin=proxied))
    assert model_joints(hung, nothing).tolist() == [0, 1]


@pytest.mark.parametrize("options", [*({"scheme": scheme} for scheme in SCHEMES), {"translations": True}])
def test_the_parameters_are_known_from_sizes_alone(scene, toy_model, options):
    model = toy_model(scene, **options)
    found = {name: tuple(value.shape) for name, value in model.state_dict().items()}
    assert parameter_shapes(scene, model.config, model.joints) == found
