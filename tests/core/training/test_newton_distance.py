# SPDX-License-Identifier: Apache-2.0
"""The distance to a Newton step in training: the step by the simulator's Hessian, the gradient in closed form."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ssilk_core.physics.collision import CollisionBody, SmoothedDistance
from ssilk_core.physics.energy import GarmentEnergy
from ssilk_core.physics.simulate.incremental_potential import IncrementalPotential, StepInputs
from ssilk_core.scene.fabrics import Fabric
from ssilk_core.training import newton_distance
from ssilk_core.training.motion_bank import build_bank
from ssilk_core.training.newton_distance import EVERY, NewtonDistance
from ssilk_core.training.objective import Objective, total

CPU, FABRIC, DT = torch.device("cpu"), Fabric("toy", bending=1e-4, margin=0.02), 1 / 30


@pytest.fixture
def scene(patched_scene):
    return patched_scene


@pytest.fixture
def cloth(scene):
    """A garment's energy, and positions (V, 3, 2) near rest, with planes that some of its samples press into."""
    energy = GarmentEnergy(scene.garment.mesh, FABRIC, scene.classes)
    generator = torch.Generator().manual_seed(0)
    rest = torch.tensor(np.array(scene.garment.mesh.points), dtype=torch.float32)[:, :, None]
    x = rest + 0.003 * torch.randn(len(rest), 3, 2, generator=generator)
    sampled = energy.cloth.positions(x)
    normal = torch.nn.functional.normalize(torch.randn(sampled.shape, generator=generator), dim=1)
    offset = (normal * sampled).sum(1) - 0.02 + 0.01 * torch.randn(len(sampled), 2, generator=generator)
    return energy, x, (normal, offset), torch.randn(x.shape, generator=generator)


def test_the_step_solves_with_the_hessian_of_the_simulator(scene, cloth, monkeypatch):
    energy, x, (normal, offset), gradient = cloth
    monkeypatch.setattr(newton_distance, "CG_ITERATIONS", 2000)
    monkeypatch.setattr(newton_distance, "REDUCTION", 1e-7)
    step = NewtonDistance(scene, energy, DT, 1.0).step(x, gradient, torch.tensor([True, False]), [normal, offset])
    potential = IncrementalPotential(scene, FABRIC, device=CPU)
    flat = SmoothedDistance(normal.double(), offset.double(), x.new_zeros(len(normal), 3, 3, 2))
    wide, gravity = x.double(), torch.zeros(3, 2)
    for frame, past in enumerate([{"predicted": wide, "advected": wide, "dt": DT}, {}]):
        inputs = StepInputs(None, gravity, skinned=wide, **past)
        matrix = potential.hessian(wide, inputs, flat).rows.to_dense().double()
        side = len(matrix) // 2
        own = matrix[frame * side :][:side, frame * side :][:, :side]
        right = -gradient[potential.free, :, frame].double().reshape(-1)
        expected = torch.linalg.solve(own, right).reshape(-1, 3)
        assert (step[potential.free, :, frame] - expected).abs().max() < 1e-3 * expected.abs().max()
    assert (step.index_fill(0, potential.free, 0) == 0).all()


def test_where_inertia_is_all_the_gradient_grows_by_the_weight(scene, cloth):
    energy, x, planes, gradient = cloth
    distance = NewtonDistance(scene, energy, 1e-6, 3.0)
    distance.planes = planes
    found = distance.gradient(x, gradient, moving=2)
    free, solved = distance.free, range(0, 2, EVERY)
    expected = gradient.clone()
    for frame in solved:
        expected[free, :, frame] *= 1 + 3.0 * EVERY
    assert torch.allclose(found, expected, rtol=1e-3)


def test_training_follows_it_and_the_energy_alone_without(scene, toy_model, toy_motion):
    model = toy_model(scene, feedback_points=0)
    energy = GarmentEnergy(scene.garment.mesh, FABRIC, scene.classes)
    body = CollisionBody(scene.character.merged_body(), scene.character.skeleton.joint_count, device=CPU)
    bank = build_bank([toy_motion(scene, 12)], scene.character.skeleton, model.joints, model.config.fps, CPU)
    frames, down = torch.arange(8), torch.tensor([0.0, -1.0, 0.0]).expand(8, 3)
    found = []
    for weight in (0.0, 1e-9, 10.0):
        model.zero_grad()
        loss = total(Objective(model, energy, body, bank, newton_weight=weight).static(frames, down))
        loss.backward()
        found.append((float(loss.detach()), model.decoder.shapes.grad.clone()))
    (plain, without), (_, tiny), (same, pulled) = found
    assert plain == same
    assert torch.allclose(without, tiny, rtol=1e-4, atol=1e-7)
    assert not torch.allclose(without, pulled, rtol=1e-2)
