# SPDX-License-Identifier: Apache-2.0
"""The moving average of the parameters against its closed form, and how little it keeps of what it began with."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from ssilk_core.training.settings import TrainConfig
from ssilk_core.training.step import Stepper, averaging_decay
from ssilk_core.training.windows import WindowSampler

CONFIG = TrainConfig(
    iterations=40, static_fraction=0.25, pretraining_batch=4, batch=2, window=5, static_batch=2,
    static_learning_rate=0.01, learning_rate=0.01, learning_rate_warmup=0, ema_decay=0.7,
)  # fmt: skip


def stepped(scene, toy_motion, toy_model, toy_objective, config: TrainConfig) -> tuple[Stepper, list[torch.Tensor]]:
    """Train; return the stepper and all parameters before the first step and after each, one row each."""
    objective = toy_objective(scene, toy_model(scene), toy_motion(scene, 30))
    sampler = WindowSampler(objective.bank, config, 8, torch.Generator().manual_seed(4))
    stepper = Stepper(objective.model, objective, sampler, config)
    rows = [flat(stepper.model)]
    for iteration in range(config.iterations):
        stepper.run(iteration)
        rows.append(flat(stepper.model))
    return stepper, rows


def flat(model: torch.nn.Module) -> torch.Tensor:
    return torch.cat([value.detach().double().flatten() for value in model.parameters()])


def test_the_average_is_its_closed_form(scene, toy_motion, toy_model, toy_objective):
    """Each step weighs 1 - d of itself times the decays of all steps after it, in both phases."""
    stepper, rows = stepped(scene, toy_motion, toy_model, toy_objective, CONFIG)
    ramp = [(1 + t) / (10 + t) for t in range(40)]
    decays = [min(0.7, d) for d in (*ramp[:10], *ramp[:30])]
    weights = [math.prod(decays), *((1 - d) * math.prod(decays[step + 1 :]) for step, d in enumerate(decays))]
    assert sum(weights) == pytest.approx(1)
    expected = sum(weight * row for weight, row in zip(weights, rows))
    torch.testing.assert_close(flat(stepper.ema_model), expected, rtol=1e-5, atol=1e-6)
    assert (flat(stepper.ema_model) - rows[-1]).abs().max() > 5e-4


def test_without_a_decay_the_average_is_the_model(scene, toy_motion, toy_model, toy_objective):
    stepper, _ = stepped(scene, toy_motion, toy_model, toy_objective, replace(CONFIG, iterations=12, ema_decay=0.0))
    for averaged, own in zip(stepper.ema_model.parameters(), stepper.model.parameters()):
        assert torch.equal(averaged, own)


@pytest.mark.parametrize("static_fraction", [0.0, 0.3])
@pytest.mark.parametrize("iterations", [500, 4706, 250_000])
def test_a_run_forgets_what_the_phase_began_with(iterations, static_fraction):
    config = TrainConfig(iterations=iterations, static_fraction=static_fraction, ema_decay=0.9995)
    steps = range(config.static_iterations, iterations)
    assert math.prod(averaging_decay(config, step) for step in steps) < 1e-9
    assert averaging_decay(config, iterations - 1) == pytest.approx(min(0.9995, 1 - 9 / len(steps)), abs=1e-3)
