# SPDX-License-Identifier: Apache-2.0
"""Integration schemes by hand numbers, and the bounds that hold by design."""

import importlib.util
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from ssilk_core.network.model.integrators import integrator, soft_clamp
from ssilk_core.network.schemes import SCHEMES
from ssilk_core.network.settings import ModelConfig
from ssilk_core.scene.kinematics import motion_transforms, skinning_matrices

FREE = {"latent_bound": 0.0, "max_latent_step": 0.0}


class Says(nn.Module):
    """A stepper that records what it sees and always answers the same."""

    def __init__(self, answer: float) -> None:
        super().__init__()
        self.answer, self.seen = answer, None

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        self.seen = inputs
        return torch.full((len(inputs), 2), self.answer)


def spring_verlet(rates: int = 0, **options):
    return integrator(ModelConfig(**({"latent": 2} | options)), rates)


BEFORE, NOW, REST, POSE = (torch.tensor([v]) for v in ([1.0, 2.0], [1.5, 1.0], [3.0, 4.0], [9.0]))


class Sums(nn.Module):
    """Gives every dimension the weighted sum of what it sees, and remembers all of that."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[torch.Tensor] = []

    def forward(self, seen: torch.Tensor) -> torch.Tensor:
        self.seen.append(seen)
        return (seen * torch.arange(1.0, seen.shape[1] + 1)).sum(1, keepdim=True).expand(-1, 2) / 10


@torch.no_grad()
def test_spring_verlet_pulls_towards_the_rest_state():
    scheme, sums = spring_verlet(stiffness=0.5, velocity_allowance=0.9, **FREE), Sums()
    scheme.beta.fill_(0.5)
    scheme.share.copy_(torch.logit(torch.tensor([0.2, 0.4])))
    # p = (3, 4), z = (1.5, 1), v = (0.5, -1): zbar = 1.5 + 0.25 and 1 - 0.5; k = (0.1, 0.2)
    found = scheme(sums, BEFORE, NOW, REST, POSE)
    zbar = np.array([1.75, 0.5])
    seen = [1.5, 1.0, 10 * 0.5, 10 * -1.0, 3 * 1.25, 3 * 3.5, 9.0]
    held, moved = (values[0] for values in sums.seen)
    np.testing.assert_allclose(moved, seen, rtol=1e-6)
    np.testing.assert_allclose(held, [3, 4, 0, 0, 0, 0, 9], rtol=1e-6)
    spring = np.array([0.1 * 1.25, 0.2 * 3.5])
    allowed = (np.linalg.norm(spring) + np.hypot(0.5, 1)) / 2
    given = 0.01 * np.sum((moved - held).numpy() * np.arange(1, 8))
    assert given * 2**0.5 < allowed
    np.testing.assert_allclose(found, [zbar + spring + given], rtol=1e-6)


@torch.no_grad()
@pytest.mark.parametrize("share", [0.5, 0.9])
def test_the_stepper_gives_no_more_than_half_of_the_spring_and_what_motion_allows(share):
    scheme = spring_verlet(2, stiffness=0.5, velocity_allowance=share, **FREE)
    scheme.share.copy_(torch.logit(torch.tensor([0.2, 0.4])))
    turning = torch.tensor([[9.0, 3.0, 4.0]])
    found = scheme(lambda seen: 10 * Sums()(seen), BEFORE, NOW, REST, turning)
    forward = NOW + 0.7 * (NOW - BEFORE)
    spring = torch.tensor([0.1, 0.2]) * (REST - forward)
    allowed = spring.norm() / 2 + share * np.hypot(0.5, 1) + 0.05 * 5
    own = found - forward - spring
    assert own.norm().item() == pytest.approx(allowed.item(), rel=1e-5)
    assert own[0, 0] == pytest.approx(own[0, 1])  # its direction is the stepper's


@torch.no_grad()
def test_a_garment_at_rest_stays_there_whatever_the_stepper_says():
    """Under a character that holds still, rates are zero and P is where the garment rests."""
    scheme = spring_verlet(2)
    still, moving = torch.tensor([[9.0, 0, 0]]), torch.tensor([[9.0, 1, 0]])
    rest = torch.tensor([[0.5, -0.25]])
    np.testing.assert_allclose(scheme(Sums(), rest, rest, rest, still), rest, atol=1e-7)
    assert (scheme(Sums(), rest, rest, rest, moving) - rest).abs().min() > 0.03  # in each of two dimensions


class Holds(nn.Module):
    """Wants to keep the garment where it is: cancels any spring."""

    def forward(self, seen: torch.Tensor) -> torch.Tensor:
        return -1e3 * seen[:, 4:6]


@torch.no_grad()
@pytest.mark.parametrize("share, frames", [(0.5, 600), (0.9, 1000)])
@pytest.mark.parametrize("start", [[2.0, -1.0], [0.5, -0.2], [-3.0, 3.0]])
def test_no_stepper_holds_a_garment_up_under_a_character_that_holds_still(start, share, frames):
    """Half of the slowest spring is left, which takes hundreds of frames; more where S may slow the motion."""
    scheme = spring_verlet(2, velocity_allowance=share)
    still, rest = torch.tensor([[9.0, 0, 0]]), torch.tensor([[0.5, -0.25]])
    z = [torch.tensor([start])] * 2
    for _ in range(frames):
        z = [z[-1], scheme(Holds(), z[-2], z[-1], rest, still)]
    assert (z[-1] - rest).norm() < 0.05 * (torch.tensor([start]) - rest).norm()


def test_gradients_are_finite_where_nothing_moves():
    scheme = spring_verlet(2)
    stepper, rest = nn.Linear(9, 2, bias=False), torch.zeros(1, 2)
    for parameter in stepper.parameters():
        nn.init.zeros_(parameter)
    scheme(stepper, rest, rest, rest, torch.tensor([[9.0, 0, 0]])).sum().backward()
    scheme(stepper, rest, rest + 1, rest, torch.tensor([[9.0, 1, 0]])).sum().backward()
    found = [p.grad for p in (*stepper.parameters(), *scheme.parameters())]
    assert all(torch.isfinite(gradient).all() for gradient in found)


@pytest.mark.parametrize("stiffness", [0.01, 0.2, 1.0])
def test_springs_start_spread_under_their_limit(stiffness):
    scheme = spring_verlet(stiffness=stiffness, latent=16)
    share = torch.sigmoid(scheme.share.detach())
    assert torch.isfinite(scheme.share).all() and (share.diff() > 0).all()
    assert 0 < share[0] * stiffness <= 0.011 and share[-1].item() == pytest.approx(0.9, abs=1e-5)


@pytest.mark.parametrize("k", [1e-6, 1e-3, 0.01, 0.1, 0.2, 0.5, 0.9, 1.0])
def test_a_spring_alone_is_stable_for_every_stiffness(k):
    scheme = spring_verlet()
    beta = float(scheme.beta.detach()[0])
    matrix = np.array([[(1 - k) * (1 + beta), -(1 - k) * beta], [1, 0]])
    assert np.abs(np.linalg.eigvals(matrix)).max() < 1


@torch.no_grad()
def test_a_spring_alone_settles_at_the_rest_state():
    scheme = spring_verlet(latent=2)
    before, now = torch.tensor([[-1.0, 2.0]]), torch.tensor([[-0.8, 1.5]])
    rest = torch.tensor([[0.5, -0.5]])
    for _ in range(1500):
        before, now = now, scheme(Says(0.0), before, now, rest, POSE)
    np.testing.assert_allclose(now, rest, atol=1e-4)


def test_the_limit_is_soft_odd_and_the_identity_near_zero():
    values = torch.linspace(-1e7, 1e7, 1001)
    assert soft_clamp(values, 4.0).abs().max() <= 4
    small = torch.tensor([-0.01, 0.0, 0.02])
    np.testing.assert_allclose(soft_clamp(small, 4.0), small, rtol=1e-4)
    assert torch.equal(soft_clamp(values, 0.0), values)


@torch.no_grad()
@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("answer", [1e6, float("inf")])
def test_no_stepper_can_drive_the_state_out_of_its_bound(scheme, answer):
    config = ModelConfig(latent=2, scheme=scheme)
    step = integrator(config)
    z = [torch.zeros(1, 2), torch.zeros(1, 2)]
    for count in range(300):
        says = Says(answer if count // 50 % 2 else -answer)
        z = [z[-1], step(says, z[-2], z[-1], REST, POSE)]
        assert z[-1].abs().max() <= config.latent_bound
    assert torch.isfinite(z[-1]).all()


@torch.no_grad()
def test_one_step_goes_no_further_than_allowed():
    step = spring_verlet(max_latent_step=0.15, latent_bound=0.0)
    for answer in (1e6, -1e6):
        z = step(Says(answer), BEFORE, NOW, REST, POSE)
        assert (z - NOW - 0.7 * (NOW - BEFORE)).abs().max() <= 0.15 + 1e-6


@torch.no_grad()
def test_decoded_cloth_stays_within_reach_of_what_holds_it(scene, toy_motion, toy_model):
    """Blendshapes end at their range and proxies turn about their own joints, whatever the state."""
    model, motion = toy_model(scene, scale=4.0), toy_motion(scene, 64)
    skeleton = scene.character.skeleton
    matrices = skinning_matrices(motion_transforms(motion, skeleton.parents), skeleton.bind_transforms)
    character = torch.tensor(matrices[:, :, :3].transpose(1, 2, 3, 0), dtype=torch.float32)
    x = model.vertices(model.integrator.bound(1e6 * torch.randn(64, 8)), character).permute(2, 0, 1).numpy()
    points, (upper, lower) = scene.garment.mesh.points, scene.rig.bind_transforms[:, :3, 3]
    free = scene.classes != 0
    play = np.zeros(60)
    play[free] = model.decoder.shapes.norm(dim=1).sum(1).numpy()
    # A point on the lower proxy swings about it, which swings about the upper one, which the spine carries.
    radius = np.maximum(np.linalg.norm(points - lower, axis=1) + np.linalg.norm(upper - lower), 0)
    radius = np.maximum(radius, np.linalg.norm(points - upper, axis=1)) + play
    anchor = (matrices[:, 1] @ np.append(upper, 1))[:, :3]
    loose = scene.classes == 2
    assert (np.linalg.norm(x - anchor[:, None], axis=2) <= radius + 1e-5)[:, loose].all()


@pytest.mark.skipif(importlib.util.find_spec("triton") is None, reason="kernels need Triton")
@pytest.mark.parametrize(
    "size, options",
    [
        (1.0, {}),
        (30.0, {}),
        (1.0, {"latent_bound": 0.0, "max_latent_step": 0.0}),
        (0.0, {}),
        (1.0, {"velocity_allowance": 0.0} | FREE),
        (1.0, {"velocity_allowance": 0.1} | FREE),
    ],
)
@torch.no_grad()
def test_the_kernels_step_as_their_reference_does(size, options, monkeypatch):
    """States of a few sizes, so that each of the limits is met; one of them is lost."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    generator = torch.Generator().manual_seed(7)
    scheme = spring_verlet(latent=5, **options)
    scheme.rates = 2
    scheme.beta.add_(0.1 * torch.randn(5, generator=generator))
    stepper = nn.Linear(15 + 6, 5, bias=False)
    torch.nn.init.normal_(stepper.weight, generator=generator)
    before, now, rest = size * torch.randn(3, 9, 5, generator=generator)
    now[4, 2] = torch.nan
    pose = torch.randn(9, 6, generator=generator)
    pose[:3, -2:] = 0
    expected = scheme(stepper, before, now, rest, pose)
    assert expected[4].isnan().any() and expected[:4].isfinite().all()
    if "velocity_allowance" in options:
        free = replace(scheme.config, velocity_allowance=1.0)
        more = integrator(free, 2)
        more.load_state_dict(scheme.state_dict())
        assert (more(stepper, before, now, rest, pose) - expected)[:4].abs().max() > 0.1  # the limit is met
    monkeypatch.setattr("ssilk_core.physics.kernels.available", lambda device: True)
    found = scheme.to(device)(stepper.to(device), *(v.to(device) for v in (before, now, rest, pose)))
    lost = scheme(
        lambda seen: seen[:, :5] * seen.new_tensor([1, 1, torch.nan, 1, 1]),
        *(v.to(device) for v in (rest, rest, rest, pose)),
    )
    assert lost.isnan().all()  # of what S gives one dimension is lost, which has no length
    torch.testing.assert_close(found.cpu(), expected, rtol=1e-5, atol=2e-6, equal_nan=True)
