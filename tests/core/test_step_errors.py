# SPDX-License-Identifier: Apache-2.0
"""What single steps miss: a closed form, the solver itself, and the frames in which a validation measures it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ssilk_core.assets import LOOSE
from ssilk_core.collision import CollisionBody
from ssilk_core.constants import GRAVITY
from ssilk_core.energy import GarmentEnergy
from ssilk_core.fabrics import Fabric
from ssilk_core.motion_bank import build_bank
from ssilk_core.simulate import newton
from ssilk_core.simulate.incremental_potential import StepInputs
from ssilk_core.simulate.newton import SolverOptions, minimise_from
from ssilk_core.training.newton_steps import NewtonSteps
from ssilk_core.training.step_errors import StepErrors
from ssilk_core.training.validation import Validator

CPU, FPS, FABRIC = torch.device("cpu"), 30.0, Fabric("toy", bending=1e-4, margin=0.02)


def test_free_cloth_misses_what_it_is_off_its_fall(scene, monkeypatch):
    """Without pins, body and air a rigid error d of a falling garment costs m d^2 / (2 dt^2), and the step is -d."""
    monkeypatch.setattr(newton, "REDUCTION", 1e-6)
    free = replace(scene, garment=replace(scene.garment, classes=np.full_like(scene.classes, LOOSE)))
    steps = NewtonSteps(free, Fabric("toy", bending=1e-4, drag=0.0), FPS, CPU)
    start = torch.tensor(scene.garment.mesh.points, dtype=torch.float32)[:, :, None].repeat(1, 1, 2)
    velocity = torch.tensor([0.3, -0.2, 0.1])[:, None] / FPS
    off = torch.tensor([[0.003, 0.0], [0.0, 0.0], [-0.004, 0.0]])
    fall = torch.tensor([0.0, -GRAVITY, 0.0])[:, None] / FPS**2
    path = start, start + velocity, start + 2 * velocity + fall + off
    energy, square = steps.measure(path, start, None, torch.zeros(3, 2))
    mass = float(steps.potential.mass.sum())
    assert energy[0] == pytest.approx(0.5 * mass * (0.005 * FPS) ** 2, rel=1e-3)
    assert square[0].sqrt() == pytest.approx(0.005, rel=1e-3)
    assert energy[1] < 1e-4 * energy[0] and square[1].sqrt() < 5e-5


@pytest.fixture
def rolled(scene, toy_motion, toy_model):
    """A validator of two clips, a model, and its states."""
    clips = [toy_motion(scene, count, path=f"/clips/{name}.usdc:/Anim") for count, name in ((6, "a"), (12, "b"))]
    model, energy = toy_model(scene), GarmentEnergy(scene.garment.mesh, FABRIC)
    body = CollisionBody(scene.character.merged_body(), 3, device=CPU)
    bank = build_bank(clips, scene.character.skeleton, model.joints, FPS, CPU)
    return Validator(bank, energy, body, scene, model.decoder.rest, FPS, 50, spans=clips), model


def test_a_validation_measures_steps_spread_over_its_clips(rolled, monkeypatch):
    validator, model = rolled
    monkeypatch.setattr("ssilk_core.training.validation.STEPS", (3, 3))
    score = validator.score(model)
    assert score.steps and validator.lbs_score().steps is None
    steps, bank, found = NewtonSteps(validator.scene, FABRIC, FPS, CPU), validator.bank, []
    for clip, frame in ((0, 3), (1, 3), (1, 9)):
        span = validator.clips[clip]
        latents = validator._states([span], model)[0]
        frames = torch.arange(frame - 2, frame + 1)
        character = bank.character(span.start + frames)
        with torch.no_grad():
            x, lbs = model.vertices(latents[frames], character), validator.lbs_vertices(character)
        shift = (bank.root[span.start + frame] - bank.root[span.start + frame - 1])[:, None]
        body = validator.body.pose(character, exact=True).select(torch.tensor([2]))
        found.append([float(v) for v in steps.measure(x.split(1, dim=-1), lbs[..., 2:], body, shift)])
    energy, square = np.array(found).T
    assert score.steps == StepErrors(3, pytest.approx(energy.mean()), pytest.approx(square.mean() ** 0.5))


def test_steps_of_the_solver_miss_nothing(rolled):
    validator, _ = rolled
    steps, bank, span = NewtonSteps(validator.scene, FABRIC, FPS, CPU), validator.bank, validator.clips[1]
    character = bank.character(torch.arange(span.start, span.start + 3))
    lbs = validator.lbs_vertices(character)
    body = validator.body.pose(character, exact=True).select(torch.tensor([2]))
    shift = (bank.root[span.start + 2] - bank.root[span.start + 1])[:, None]
    gravity = torch.tensor([[0.0], [-GRAVITY], [0.0]])
    inputs = StepInputs(body, gravity, 2 * lbs[..., 1:2] - lbs[..., :1], lbs[..., 1:2] + shift, 1 / FPS, lbs[..., 2:])
    solved = minimise_from(steps.potential, lbs[..., 2:], inputs, SolverOptions(tolerance=1e-4)).x
    before, last, here = lbs.split(1, dim=-1)
    (missed, near), (whole, far) = (
        steps.measure([before, last, x], lbs[..., 2:], body, shift) for x in (solved, here)
    )
    assert missed < 1e-4 * whole and near < 1e-4 * far
