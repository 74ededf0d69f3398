# SPDX-License-Identifier: Apache-2.0
"""Trainings that have minutes instead of iterations."""

from __future__ import annotations

from dataclasses import replace
from math import inf

import pytest
import torch

from ssilk_core.config import TrainConfig
from ssilk_core.errors import SsilkError
from ssilk_core.events import Message, Progress, Started, silent
from ssilk_core.training import budget
from ssilk_core.training import run as training
from ssilk_core.training.budget import fitting_iterations, scale_schedule
from ssilk_core.training.parallel import ProcessGroup
from ssilk_core.training.run import TrainingRun, train
from ssilk_core.training.state import load_state, state_path
from ssilk_core.training.step import learning_rate

from .test_training_run import SHORT, job  # noqa: F401  (a fixture)

PLAN = TrainConfig(iterations=1000, static_fraction=0.3, learning_rate_warmup=50, validate_every=100, ema_decay=0.998)


@pytest.mark.parametrize("iterations", [50, 1000, 8000])
def test_a_stretched_schedule_has_the_same_shape(iterations):
    found, factor = scale_schedule(PLAN, iterations), iterations / PLAN.iterations
    assert found.iterations == iterations and found.static_iterations == round(PLAN.static_iterations * factor)
    assert found.iterations // found.validate_every == 10
    for share in (0.1, 0.4, 0.6, 0.9):
        rates = [learning_rate(config, int(share * config.iterations)) for config in (found, PLAN)]
        assert rates[0] == pytest.approx(rates[1], rel=0.02)
    # The weight of the first parameters in the moving average at the end.
    assert found.ema_decay**iterations == pytest.approx(PLAN.ema_decay**1000, rel=1e-6)
    assert scale_schedule(replace(PLAN, ema_decay=0.0), iterations).ema_decay == 0


class Clocked:
    """A stepper that needs a given time for each step of a phase, by a clock of its own."""

    device = torch.device("cpu")

    def __init__(self, static: float, dynamic: float) -> None:
        self.times, self.now = (static, dynamic), 0.0

    def run(self, iteration: int) -> None:
        self.now += self.times[iteration >= PLAN.static_iterations]


def planned(monkeypatch: pytest.MonkeyPatch, seconds: float, scoring: float = 0.0) -> int:
    stepper = Clocked(0.1, 0.4)
    monkeypatch.setattr(budget, "_clock", lambda device: stepper.now)
    return fitting_iterations(stepper, PLAN, seconds, scoring, "cape.safetensors")  # type: ignore[arg-type]


def test_as_many_iterations_are_planned_as_fit(monkeypatch):
    each = 0.3 * 0.1 + 0.7 * 0.4
    assert planned(monkeypatch, 600) == int(0.9 * 600 / each)
    assert planned(monkeypatch, 600, scoring=10) == int((0.9 * 600 - 8 * 10) / each)
    with pytest.raises(
        SsilkError, match=r"^cape.safetensors: 14 iterations fit into the remaining minutes .* smaller preset"
    ):
        planned(monkeypatch, 5)


def test_a_run_with_minutes_is_one_of_as_many_iterations(job, monkeypatch):  # noqa: F811
    """Timing its steps leaves no trace in what is learned."""
    real, said = training.fitting_iterations, []
    monkeypatch.setattr(budget, "MIN_ITERATIONS", 1)
    monkeypatch.setattr(training, "fitting_iterations", lambda *given: real(*given) * 0 + 11)
    trained = train(job("minutes", minutes=5.0), said.append)
    assert trained.finished and trained.iterations == 11
    assert [event.total for event in said if isinstance(event, Started)] == [11]
    assert any(
        "11 iterations are planned for 5 minutes" in event.text for event in said if isinstance(event, Message)
    )
    lbs = job("iterations", scale_schedule(SHORT, 11))
    train(lbs, silent)
    asked = job("minutes", minutes=5.0)
    _, one = load_state(state_path(asked.output), asked.identity())
    _, other = load_state(state_path(lbs.output), lbs.identity())
    assert one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


def test_a_run_ends_with_its_time_and_goes_on_with_more(job, monkeypatch):  # noqa: F811
    monkeypatch.setattr(training, "fitting_iterations", lambda *_: 13)
    with monkeypatch.context() as patch:
        patch.setattr(TrainingRun, "time_left", property(lambda run: 8.0 - run.state.iteration))
        said: list = []
        trained = train(job("early", minutes=1.0), said.append)
    assert trained.finished and trained.iterations == 8
    assert any(event.text == "time is up at iteration 8 of 13" for event in said if isinstance(event, Message))
    progress = [event for event in said if isinstance(event, Progress)]
    assert progress[-1].done == 8 and all(event.seconds_left <= 8 - event.done for event in progress)
    state, _ = load_state(state_path(job("early").output), job("early").identity())
    assert state.best and state.curve[-1].iteration == 8
    assert train(job("early", minutes=9.0, resume=True), silent).iterations == 13


@pytest.mark.parametrize("resume", [False, True])
def test_a_process_group_has_no_minutes(job, resume):  # noqa: F811
    """Each process would end by a clock of its own, and the others wait for it."""
    with pytest.raises(SsilkError, match="minutes for a group of processes; its clocks differ; set the iterations"):
        TrainingRun(job("group", minutes=1.0, resume=resume), silent, ProcessGroup(0, 2))


def test_time_is_up_when_no_validation_fits_any_more(job, monkeypatch):  # noqa: F811
    monkeypatch.setattr(training, "fitting_iterations", lambda *_: 13)
    run = TrainingRun(job("clock", minutes=1.0), silent)
    now = run._began
    monkeypatch.setattr(training.time, "monotonic", lambda: now)
    run.validation_seconds = 10.0
    for spent in (49.0, 51.0):
        now = run._began + spent
        assert run.time_left == pytest.approx(50.0 - spent)
    assert TrainingRun(job("endless"), silent).time_left == inf
