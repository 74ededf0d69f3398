# SPDX-License-Identifier: Apache-2.0
"""The closed loop of single steps: of a linear stepper made by hand, and of networks by central differences."""

from __future__ import annotations

import json
import math
from dataclasses import asdict

import numpy as np
import pytest
import torch
from torch import Tensor

from ssilk_core.events import finite
from ssilk_core.network.model.feedback import BodyFrames
from ssilk_core.network.parameters import descriptor_sizes
from ssilk_core.quality.evaluation.asked import EvaluationClips, EvaluationOptions
from ssilk_core.quality.evaluation.closed_loop import closed_loop, spectral_radius, step_derivatives
from ssilk_core.quality.evaluation.figures import ResultRow
from ssilk_core.quality.evaluation.methods import EvaluatedMethod, EvaluationScene, Network, TakeSet, build_take_set
from ssilk_core.quality.evaluation.run import evaluate
from ssilk_core.quality.evaluation.tables import tables
from ssilk_core.quality.evaluation.takes import takes_of
from ssilk_core.scene.fabrics import Fabric
from ssilk_core.scene.plain import from_plain

pytestmark = pytest.mark.usefixtures("few_contacts")

FPS, JOINTS, CPU = 30.0, np.arange(3), torch.device("cpu")
RADII, ANGLES = torch.tensor([0.5, 0.97, 0.8]), torch.tensor([0.1, 0.7, 2.0])


class Swings:
    """Three damped swings in mixed coordinates, z_t = A z_{t-1} + B z_{t-2} + p / 10, of eigenvalues r e^(+-ia)."""

    def __init__(self, radii: Tensor = RADII, wind: float = 0.0) -> None:
        mixed = torch.tensor([[2.0, 1.0, 0.0], [0.0, 1.0, 0.3], [0.4, 0.0, 1.5]])
        self.a, self.b = (
            mixed @ torch.diag(values) @ mixed.inverse() for values in (2 * radii * ANGLES.cos(), -radii.square())
        )
        self.wind = wind

    def initial(self, static: Tensor) -> Tensor:
        return static[:, :3]

    def roll(self, states: list[Tensor], rest: Tensor, pose: Tensor, body: BodyFrames) -> list[Tensor]:
        states = list(states)
        for p in rest:
            gust = self.wind * states[-1].square()
            states.append(states[-1] @ self.a.T + states[-2] @ self.b.T + p / 10 + gust)
        return states

    def vertices(self, z: Tensor, character: Tensor, /) -> Tensor:
        raise AssertionError("nothing is decoded")


@pytest.fixture
def dressed(scene) -> EvaluationScene:
    return EvaluationScene(scene, Fabric("toy", bending=1e-4, margin=0.02), FPS, CPU)


@pytest.fixture
def take_set(scene, dressed, toy_motion) -> TakeSet:
    skeleton = scene.character.skeleton
    takes = [take for frames in (12, 9) for take in takes_of("sway", toy_motion(scene, frames), skeleton, FPS)]
    return build_take_set(takes, dressed, JOINTS)


def test_derivatives_of_a_linear_step_are_its_matrices(toy_body, scene):
    swings = Swings()
    before, now, rest = torch.randn(3, 3, generator=torch.Generator().manual_seed(1))
    by_before, by_now = step_derivatives(swings, before, now, rest, torch.zeros(4), toy_body(scene, 3, 1))
    np.testing.assert_allclose(by_before, swings.b, atol=1e-6)
    np.testing.assert_allclose(by_now, swings.a, atol=1e-6)
    assert spectral_radius(by_before, by_now) == pytest.approx(0.97, abs=1e-5)
    by_before[1, 2] = torch.nan
    assert spectral_radius(by_before, by_now) == math.inf


@pytest.mark.parametrize(
    "options", [{"feedback_points": 6}, {"feedback_points": 0}, {"feedback_points": 6, "max_latent_step": 0.0}]
)
def test_derivatives_of_a_network_are_central_differences(scene, toy_model, toy_body, options):
    """With what S sees of the decoded cloth, which changes with both states."""
    model, body = toy_model(scene, **options).double(), toy_body(scene, 3, 1)
    body = BodyFrames(body.matrices.double(), body.bend.double())
    dice = torch.Generator().manual_seed(2)
    before, away, rest = 0.3 * torch.randn(3, 8, generator=dice, dtype=torch.float64)
    now = before + 0.2 * away
    pose = torch.randn(sum(descriptor_sizes(scene, JOINTS, model.config)), generator=dice, dtype=torch.float64)

    def step(states: Tensor) -> Tensor:
        seen = model.seen_from(states[None, 0], states[None, 1], body)
        return model.step(states[None, 0], states[None, 1], rest[None], pose[None], seen)[0]

    found = step_derivatives(model, before, now, rest, pose, body)
    small, here = 1e-6, torch.stack([before, now])
    with torch.no_grad():
        for which in (0, 1):
            for latent in range(8):
                shift = torch.zeros_like(here)
                shift[which, latent] = small
                expected = (step(here + shift) - step(here - shift)) / (2 * small)
                np.testing.assert_allclose(found[which][:, latent], expected, rtol=1e-5, atol=1e-7)
    assert found[0].abs().max() > 0.1 and found[1].abs().max() > 0.1


def test_a_network_without_a_past_forgets_all(scene, toy_model, toy_body):
    model = toy_model(scene, scheme="quasi_static")
    before, now, rest = torch.randn(3, 8)
    found = step_derivatives(model, before, now, rest, torch.zeros(model.described), toy_body(scene, 3, 1))
    assert spectral_radius(*found) == 0


def test_radii_are_those_at_the_states_of_rollouts(take_set):
    """Wind makes each step's derivative depend on its own last state: A + 2 w diag(z_{t-1})."""
    network = Network(Swings(wind=0.5), take_set)
    found = closed_loop(network, [0, 1], 100)
    radii = []
    for states in network.states:
        for now in states[1:-1]:
            a = network.model.a + torch.diag(now)
            loop = torch.cat([torch.cat([torch.zeros(3, 3), torch.eye(3)], 1), torch.cat([network.model.b, a], 1)])
            radii.append(np.abs(np.linalg.eigvals(loop.double().numpy())).max())
    assert found.states == len(radii) == 10 + 7 and max(radii) - min(radii) > 1e-3
    assert found.max_radius == pytest.approx(max(radii), abs=1e-5)
    assert found.median_radius == pytest.approx(np.median(radii), abs=1e-5)
    few = closed_loop(network, [1], 3)
    assert (few.states, few.max_radius) == (3, pytest.approx(max(radii[10 + at] for at in (1, 3, 5)), abs=1e-5))
    assert closed_loop(network, [], 3) is None and closed_loop(network, [0], 0) is None


def test_the_evaluation_tells_it_of_networks_in_every_split(scene, dressed, toy_motion, toy_model):
    clips = {"sway": toy_motion(scene, 9), "slow": toy_motion(scene, 6, speed=0.3)}
    played = EvaluationClips(clips=clips, splits={"valid": ["sway", "slow"], "flips": ["slow"]})
    model = toy_model(scene)
    method = EvaluatedMethod("ssilk", JOINTS, lambda takes: Network(model, takes))
    options = EvaluationOptions(stops=0, loop=0, linearised=8)
    rows = list(evaluate(dressed, [method], played, options))
    loops = {(row.method, row.split): row.figures.closed_loop for row in rows}
    assert loops["LBS", "valid"] is None and loops["ssilk", "valid"].states == 8
    assert loops["ssilk", "flips"].states == 4  # of six frames, those after the first two
    assert 0 < loops["ssilk", "flips"].median_radius <= loops["ssilk", "flips"].max_radius < 2
    assert "spectral radius of a step, median" in tables(rows)
    # Of a split that is measured after others are known, the states are the same, in a smaller batch of takes.
    kept = [from_plain(ResultRow, json.loads(json.dumps(finite(asdict(row)))), figures=True) for row in rows[:3]]
    again = list(evaluate(dressed, [method], played, options, known=kept))
    found, before = again[3].figures.closed_loop, loops["ssilk", "flips"]
    assert again[:3] == rows[:3] and found.states == before.states
    assert found.median_radius == pytest.approx(before.median_radius, rel=1e-3)
    assert found.max_radius == pytest.approx(before.max_radius, rel=1e-3)
