# SPDX-License-Identifier: Apache-2.0
"""The regularisation of the latents against its closed form, and in a training step."""

from math import log
from types import SimpleNamespace

import pytest
import torch

from ssilk_core.training.latent_regularization import latent_distortion
from ssilk_core.training.settings import TrainConfig
from ssilk_core.training.windows import WindowSampler

MASS = torch.tensor([0.1, 0.3, 0.2, 0.4])


def isometric(scale: float) -> SimpleNamespace:
    """A model of four vertices that moves the garment by `scale` RMS over the mass for each latent unit."""
    directions = torch.linalg.qr(torch.randn(12, 5, generator=torch.Generator().manual_seed(3)))[0]
    spread = scale * directions / (MASS / MASS.sum()).sqrt().repeat_interleave(3)[:, None]

    def vertices(z: torch.Tensor, character: torch.Tensor) -> torch.Tensor:
        assert character.shape == (2, 3, 4, len(z))
        return (spread @ z.T).reshape(4, 3, len(z))

    skeleton = SimpleNamespace(joint_count=2)
    return SimpleNamespace(scene=SimpleNamespace(character=SimpleNamespace(skeleton=skeleton)), vertices=vertices)


@pytest.mark.parametrize("scale", [0.5, 1.0, 3.0])
def test_distances_that_agree_cost_nothing_and_others_their_logarithm_squared(scale):
    z = torch.randn(7, 5, generator=torch.Generator().manual_seed(1))
    found = latent_distortion(isometric(0.02 * scale), MASS, z, 0.02)
    torch.testing.assert_close(found, torch.full((7,), log(scale) ** 2), atol=1e-5, rtol=1e-4)


def test_equal_latents_stay_finite():
    z = torch.zeros(3, 5, requires_grad=True)
    latent_distortion(isometric(0.02), MASS, z, 0.02).sum().backward()
    assert z.grad is not None and z.grad.isfinite().all()


@pytest.mark.parametrize("weight", [0.0, 2.0])
def test_a_weight_makes_it_a_term_that_reaches_p_and_d(toy_objective, toy_model, scene, toy_motion, weight):
    model = toy_model(scene, scale=0.1)
    objective = toy_objective(scene, model, toy_motion(scene, 30))
    config = TrainConfig(batch=2, window=4, latent_regularization=weight)
    sampler = WindowSampler(objective.bank, config, model.config.latent, torch.Generator().manual_seed(0))
    dynamic, *_ = objective.window(sampler, sampler.noise(), *sampler.poses(3)[:2])
    assert ("latent regularization" in dynamic) == bool(weight)
    if weight:
        dynamic["latent regularization"].sum().backward()
        assert model.initialiser[0].weight.grad.any() and model.output[-1].weight.grad.any()
