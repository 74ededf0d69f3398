# SPDX-License-Identifier: Apache-2.0
"""The schemes of the paper's Figure 11: by hand numbers, in whole networks, and refused where not registered."""

import numpy as np
import pytest
import torch
from torch import nn

from benchmarks.helpers.paper_schemes import PAPER_SCHEMES
from ssilk_core.errors import SsilkError
from ssilk_core.network.checkpoint import load_model, model_file, save_model
from ssilk_core.network.model.integrators import integrator
from ssilk_core.network.parameters import descriptor_sizes, parameter_shapes
from ssilk_core.network.runtime import Player
from ssilk_core.network.schemes import SCHEMES
from ssilk_core.network.settings import ModelConfig
from ssilk_core.scene.fabrics import Fabric
from ssilk_core.training.objective import total
from ssilk_core.training.settings import TrainConfig
from ssilk_core.training.windows import WindowSampler

BEFORE, NOW, REST, POSE = (torch.tensor([v]) for v in ([1.0, 2.0], [1.5, 1.0], [3.0, 4.0], [9.0]))


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    for name, scheme in PAPER_SCHEMES.items():
        monkeypatch.setitem(SCHEMES, name, scheme)


def scheme_of(name: str, **options):
    free = {"latent_bound": 0.0, "max_latent_step": 0.0}
    return integrator(ModelConfig(scheme=name, latent=2, **(free | options)))


class Says(nn.Module):
    """A stepper that records what it sees and always answers the same."""

    def __init__(self, answer: float) -> None:
        super().__init__()
        self.answer, self.seen = answer, None

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        self.seen = inputs
        return torch.full((len(inputs), 2), self.answer)


@torch.no_grad()
def test_verlet_is_equations_2_and_3():
    scheme, says = scheme_of("verlet"), Says(0.25)
    scheme.alpha.copy_(torch.tensor([0.9, 1.0]))
    scheme.beta.copy_(torch.tensor([0.5, 0.8]))
    found = scheme(says, BEFORE, NOW, REST, POSE)
    # zbar = 0.9 * 1.5 + 0.5 * 0.5 and 1.0 - 0.8
    np.testing.assert_allclose(found, [[1.6 + 0.25, 0.2 + 0.25]], rtol=1e-6)
    np.testing.assert_allclose(says.seen, [[1.6, 0.2, 1.5, 1.0, 9.0]], rtol=1e-6)


@torch.no_grad()
def test_direct_is_equation_11_and_residual_equation_12():
    says = Says(0.25)
    np.testing.assert_allclose(scheme_of("direct")(says, BEFORE, NOW, REST, POSE), [[0.25, 0.25]])
    np.testing.assert_allclose(says.seen, [[1.0, 2.0, 1.5, 1.0, 9.0]])
    np.testing.assert_allclose(scheme_of("direct_residual")(says, BEFORE, NOW, REST, POSE), [[1.75, 1.25]])
    np.testing.assert_allclose(says.seen, [[1.0, 2.0, 1.5, 1.0, 9.0]])


@torch.no_grad()
def test_without_bounds_verlet_is_exactly_the_papers_recurrence():
    scheme, weights = scheme_of("verlet"), torch.randn(5, 2, generator=torch.Generator().manual_seed(0))

    class Linear(nn.Module):
        def forward(self, inputs: torch.Tensor) -> torch.Tensor:
            return inputs @ weights

    z = [torch.tensor([[0.1, -0.2]]), torch.tensor([[0.3, 0.1]])]
    expected = [*z]
    for _ in range(6):
        z.append(scheme(Linear(), z[-2], z[-1], REST, POSE))
        forward = scheme.alpha * expected[-1] + scheme.beta * (expected[-1] - expected[-2])
        expected.append(forward + torch.cat([forward, expected[-1], POSE], dim=1) @ weights)
    assert torch.equal(torch.cat(z), torch.cat(expected))
    assert z[-1].abs().max() > 10  # nothing limits it


@torch.no_grad()
def test_one_step_of_verlet_goes_no_further_than_allowed():
    step = scheme_of("verlet", max_latent_step=0.15)
    for answer in (1e6, -1e6):
        z = step(Says(answer), BEFORE, NOW, REST, POSE)
        assert (z - NOW - 0.9 * (NOW - BEFORE)).abs().max() <= 0.15 + 1e-6


@torch.no_grad()
@pytest.mark.parametrize("scheme", [*PAPER_SCHEMES, "verlet"])
@pytest.mark.parametrize("answer", [1e6, float("inf")])
def test_no_stepper_can_drive_the_state_out_of_its_bound(scheme, answer):
    step = scheme_of(scheme, latent_bound=4.0, max_latent_step=0.3)
    z = [torch.zeros(1, 2), torch.zeros(1, 2)]
    for count in range(1000):
        z = [z[-1], step(Says(answer if count // 50 % 2 else -answer), z[-2], z[-1], REST, POSE)]
        assert z[-1].abs().max() <= 4.0


def test_training_starts_from_verlet_without_a_stepper(scene, toy_model):
    model = toy_model(scene, scheme="verlet", latent_bound=0.0, max_latent_step=0.0)
    before, now = torch.randn(2, 6, 8, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        for value in (model.stepper[-1].weight, model.stepper[-1].bias):
            value.zero_()  # as a fresh model's
        seen = torch.randn(6, 3 * model.feedback.count)
        pose = torch.randn(6, model.stepper[0].in_features - 16 - seen.shape[1])
        stepped = model.step(before, now, now, pose, seen)
        expected = model.integrator.alpha * now + model.integrator.beta * (now - before)
    np.testing.assert_allclose(stepped, expected, atol=1e-6)


@pytest.mark.parametrize("scheme", [*PAPER_SCHEMES, "verlet"])
def test_networks_roll_as_they_step_and_have_the_parameters_of_their_sizes(scene, toy_model, toy_body, scheme):
    model = toy_model(scene, scheme=scheme)
    found = {name: tuple(value.shape) for name, value in model.state_dict().items()}
    assert parameter_shapes(scene, model.config, model.joints) == found
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
    torch.testing.assert_close(torch.stack(rolled), torch.stack(states), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("scheme", [*PAPER_SCHEMES, "verlet"])
def test_training_reaches_every_parameter(scene, toy_motion, toy_model, toy_objective, scheme):
    objective = toy_objective(scene, toy_model(scene, scheme=scheme), toy_motion(scene, 50))
    config = TrainConfig(batch=3, window=6, static_batch=6)
    sampler = WindowSampler(objective.bank, config, 8, torch.Generator().manual_seed(4))
    dynamic, static_batch, _ = objective.window(sampler, sampler.noise(), *sampler.poses(6))
    (total(dynamic) + total(static_batch)).backward()
    for name, value in objective.model.named_parameters():
        assert value.grad is not None and value.grad.isfinite().all() and value.grad.abs().max() > 0, name


def test_their_models_load_where_they_are_registered_and_are_refused_elsewhere(
    scene, toy_model, tmp_path, monkeypatch
):
    path, model = tmp_path / "model.safetensors", toy_model(scene, scheme="direct")
    save_model(path, model_file(model, Fabric("toy"), {}))
    assert load_model(path).config.scheme == "direct"
    with pytest.raises(SsilkError, match=r"the model's scheme is 'direct'; the runtime plays"):
        Player.load(path)
    monkeypatch.delitem(SCHEMES, "direct")
    with pytest.raises(SsilkError, match=r"model.safetensors: .*scheme 'direct'; it is one of .*; train with one of"):
        load_model(path)
