# SPDX-License-Identifier: Apache-2.0
"""Trainings that have minutes instead of iterations."""

from __future__ import annotations

import sys
from dataclasses import replace
from math import inf

import pytest
import torch

from ssilk_core.cli.main import parser
from ssilk_core.cli.train import configured
from ssilk_core.devices import default_preset
from ssilk_core.errors import SsilkError
from ssilk_core.events import Message, Progress, Started, silent
from ssilk_core.training import budget, clock
from ssilk_core.training import run as training
from ssilk_core.training.budget import (
    Pace,
    affordable_validations,
    check_possible,
    fitting_iterations,
    scale_schedule,
    timed_pace,
)
from ssilk_core.training.clock import OF_A_MODEL, RunClock
from ssilk_core.training.parallel import ProcessGroup
from ssilk_core.training.run import TrainingRun, train
from ssilk_core.training.settings import PRESETS, TrainConfig
from ssilk_core.training.state import RunState, load_state, state_path
from ssilk_core.training.step import learning_rate
from ssilk_core.training.validation import Score, Validator

from .test_training_run import SHORT, job  # noqa: F401  (a fixture)

pytestmark = pytest.mark.usefixtures("few_contacts")

PLAN = TrainConfig(
    iterations=1000, static_fraction=0.3, learning_rate_warmup=50, validate_every=100, ema_decay=0.998,
    batch=64, window=6, static_batch=64, pretraining_batch=1024,
)  # fmt: skip


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


def test_steps_of_both_phases_are_timed(monkeypatch):
    stepper = Clocked(0.1, 0.4)
    monkeypatch.setattr(budget, "_clock", lambda device: stepper.now)
    pace = timed_pace(stepper, PLAN)  # type: ignore[arg-type]
    assert (pace.static, pace.dynamic) == (pytest.approx(0.1), pytest.approx(0.4))


@pytest.mark.parametrize(("static", "dynamic", "ends", "count"), [(65.0, 80.0, 65.0, 10), (1.0, 90.0, 94.0, 4)])
def test_timing_ends_with_the_step_that_shows_that_the_minutes_are_not_enough(
    monkeypatch, static, dynamic, ends, count
):
    stepper = Clocked(static, dynamic)
    monkeypatch.setattr(budget, "_clock", lambda device: stepper.now)
    with pytest.raises(SsilkError, match=f"^cape: at most {count} iterations fit into the remaining minutes"):
        timed_pace(stepper, PLAN, lambda pace: check_possible(pace, PLAN, 360.0 - stepper.now, "cape"))
    assert stepper.now == ends


def test_minutes_that_no_estimate_allows_are_refused_before_anything_is_timed(job, monkeypatch):  # noqa: F811
    preview = PRESETS["preview"].train
    budget.check_estimate(preview, 10_000, "cpu", 360.0, "cape")  # to be measured
    budget.check_estimate(preview, 10_000, "abacus", 1.0, "cape")
    monkeypatch.setattr(TrainingRun, "_score_lbs", lambda run: pytest.fail("scored"))
    with pytest.raises(SsilkError, match=r"\d iterations fit into the remaining minutes"):
        train(job("hasty", preview, minutes=1e-3), silent)


def test_the_default_preset_follows_the_device(monkeypatch):
    assert default_preset("cpu") == "draft"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert default_preset("auto") == "preview"
    with monkeypatch.context() as unloaded:
        unloaded.delitem(sys.modules, "torch")
        unloaded.setattr("importlib.metadata.version", lambda name: "2.13.0+cpu")
        assert default_preset("auto") == "draft" and "torch" not in sys.modules
    words = ["train", "hero.usda", "--motions", "walks", "-o", "cape.safetensors", "--device", "cpu"]
    for more, size in ((), PRESETS["draft"]), (("--preset", "preview"), PRESETS["preview"]):
        assert configured(parser().parse_args([*words, *more])) == (size.model, size.train)


def test_as_many_iterations_are_planned_as_fit():
    pace, each = Pace(0.1, 0.4), 0.3 * 0.1 + 0.7 * 0.4
    assert fitting_iterations(pace, PLAN, 600) == int(0.98 * 600 / each)
    # In static training: the rest of it, and all that follows.
    found = fitting_iterations(pace, PLAN, 60, done=20)
    assert (0.3 * found - 20) * 0.1 + 0.7 * found * 0.4 == pytest.approx(0.98 * 60, rel=0.01)
    assert fitting_iterations(pace, PLAN, 40, done=300) == 300 + int(0.98 * 40 / 0.4)
    slower = pace.updated(1.4, is_static=False)
    assert slower.dynamic / slower.static == pytest.approx(4) and 0.4 < slower.dynamic < 1.4


def test_too_few_minutes_are_refused_with_what_a_step_takes_and_how_many_would_do():
    pace, each = Pace(1.0, 20.0), 0.3 * 1 + 0.7 * 20
    enough = 20 * each / 0.98
    check_possible(pace, PLAN, enough + 1e-6, "cape.safetensors")
    said = rf"^cape.safetensors: at most 14 iterations .* takes about {each:.2g} s on this.* at least 2 more minutes"
    with pytest.raises(SsilkError, match=said):
        check_possible(pace, PLAN, 14.5 * each / 0.98, "cape.safetensors")
    more = (enough - 14.5 * each / 0.98) / 60
    assert 1 < more < 2


def test_validations_take_a_tenth_of_the_time_at_most():
    long = TrainConfig(iterations=250_000)
    assert affordable_validations(long, 240, 1.0) == 24
    assert affordable_validations(long, 1e6, 1.0) == 251
    assert affordable_validations(long, 5, 1.0) == 1
    assert affordable_validations(long, 240, 0.0) == 251
    stretched = scale_schedule(long, 9000, validations=24)
    assert stretched.validate_every == 9000 / 24


def test_the_schedule_follows_the_clock(job, monkeypatch):  # noqa: F811
    """A machine that becomes three times slower gets fewer iterations, and ends in time at the last learning rate."""
    now, rates = [0.0], []
    monkeypatch.setattr(training.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(training, "timed_pace", lambda *_: Pace(1.0, 1.0))
    monkeypatch.setattr(training, "CHECK_INTERVAL", 2)
    real = TrainingRun.step

    def step(run: TrainingRun) -> None:
        rates.append(learning_rate(run.stepper.config, run.state.iteration))
        real(run)
        now[0] += 1.0 if now[0] < 20 else 3.0

    monkeypatch.setattr(TrainingRun, "step", step)
    trained = train(job("clock", minutes=1.0), silent)
    state, _ = load_state(state_path(job("clock").output), job("clock").identity())
    assert trained.finished and trained.iterations == state.planned == len(rates)
    assert 28 <= trained.iterations <= 35 and now[0] <= 60
    assert rates[-1] < 0.1 * max(rates[state.static :])
    assert state.curve[-1].iteration == trained.iterations


def test_a_run_with_minutes_is_one_of_as_many_iterations(job, monkeypatch):  # noqa: F811
    """Timing its steps leaves no trace in what is learned."""
    said: list = []
    monkeypatch.setattr(budget, "MIN_ITERATIONS", 1)
    monkeypatch.setattr(clock, "fitting_iterations", lambda *_: 11)
    trained = train(job("minutes", minutes=5.0), said.append)
    assert trained.finished and trained.iterations == 11
    assert [event.total for event in said if isinstance(event, Started)] == [11]
    assert any(
        "about 11 iterations are planned for 5 minutes" in event.text for event in said if isinstance(event, Message)
    )
    lbs = job("iterations", scale_schedule(SHORT, 11))
    train(lbs, silent)
    asked = job("minutes", minutes=5.0)
    _, one = load_state(state_path(asked.output), asked.identity())
    _, other = load_state(state_path(lbs.output), lbs.identity())
    assert one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


def test_a_run_ends_with_its_time_and_goes_on_with_more(job, monkeypatch):  # noqa: F811
    monkeypatch.setattr(clock, "fitting_iterations", lambda *_: 13)
    monkeypatch.setattr(budget, "MIN_ITERATIONS", 1)
    with monkeypatch.context() as patch:
        patch.setattr(RunClock, "time_left", property(lambda clock: 8.0 - clock.state.iteration))
        said: list = []
        trained = train(job("early", minutes=1.0), said.append)
    assert trained.finished and trained.iterations == 8
    assert any(event.text == "time is up at iteration 8 of 13" for event in said if isinstance(event, Message))
    progress = [event for event in said if isinstance(event, Progress)]
    assert progress[-1].done == 8
    known = [(event.done, event.seconds_left) for event in progress if event.seconds_left is not None]
    assert known and all(left < 8 - done + 1 for done, left in known)  # a validation ends it
    state, _ = load_state(state_path(job("early").output), job("early").identity())
    assert state.best and state.curve[-1].iteration == 8
    assert train(job("early", minutes=9.0, resume=True), said.append).iterations == 13
    assert any(getattr(event, "text", "").startswith("of 9 minutes for the whole run, ") for event in said), said


def test_the_countdown_foresees_dynamic_steps_and_validations(job, monkeypatch):  # noqa: F811
    """The first static step takes 30 s, others 1 s, and dynamic ones 4 s; these are timed ahead, and not learnt from.

    Validations take 5 s, and 2/3 of that without a model.
    """
    now, told = [0.0], []
    monkeypatch.setattr(training.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(training, "CHECK_INTERVAL", 2)
    monkeypatch.setattr(training, "FIRST_MODEL", inf)
    asked = replace(
        SHORT, iterations=20, static_fraction=0.5, validate_every=10, static_batch=2, pretraining_batch=4, batch=2,
        window=5, initial_loss=False,
    )  # fmt: skip
    real, score, score_lbs = TrainingRun.step, Validator.score, Validator.lbs_score

    def step(run: TrainingRun) -> None:
        now[0] += 4.0 if run.state.iteration >= 10 else 1.0 if run.state.iteration else 30.0
        real(run)

    def scored(validator: Validator, model: object) -> Score:
        now[0] += 5.0
        return score(validator, model)

    def scored_lbs(validator: Validator) -> Score:
        now[0] += 5.0 / OF_A_MODEL
        return score_lbs(validator)

    def timed(*words: object) -> Pace:
        now[0] += 8.0
        timed_pace(*words)
        return Pace(1.0, 4.0)

    train(job("alone", asked), silent)
    monkeypatch.setattr(TrainingRun, "step", step)
    monkeypatch.setattr(Validator, "score", scored)
    monkeypatch.setattr(Validator, "lbs_score", scored_lbs)
    monkeypatch.setattr(training, "timed_pace", timed)
    train(job("countdown", asked), lambda event: told.append((now[0], event)))
    progress = [(at, event) for at, event in told if isinstance(event, Progress)]
    assert [event.done for _, event in progress] == [1, *range(2, 21, 2)]
    assert progress[0][1].seconds_left is None
    for at, event in progress[1:]:
        assert event.seconds_left == pytest.approx(now[0] - at, abs=0.5), event.done
    (_, one), (_, other) = (
        load_state(state_path(each.output), each.identity())
        for each in (job("alone", asked), job("countdown", asked))
    )
    assert one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


def test_validations_that_take_long_become_fewer(job):  # noqa: F811
    clock = RunClock(job("long", minutes=2.0), RunState({}), training.time.monotonic())
    clock.scored_lbs(1.0)
    clock.state.validations = affordable_validations(PLAN, 120, clock.validation_seconds)
    assert clock.state.validations == 8 and clock.validation_seconds == OF_A_MODEL
    clock.validated(30.0)
    assert clock.state.validations == 1 and clock.validation_seconds == 30.0
    clock.validated(10.0)  # not the one at the end
    assert clock.validation_seconds == 30.0
    quick = RunClock(job("long", minutes=2.0), RunState({}, validations=3), training.time.monotonic())
    quick.scored_lbs(30.0)
    quick.validated(1.0)
    assert quick.state.validations == 3 and quick.validation_seconds == 1.0


def test_a_run_whose_time_ends_in_static_training_has_not_moved(job, monkeypatch):  # noqa: F811
    monkeypatch.setattr(clock, "fitting_iterations", lambda *_: 13)
    monkeypatch.setattr(budget, "MIN_ITERATIONS", 1)
    asked = replace(SHORT, static_fraction=0.5)
    for end, moves in ((3, False), (9, True)):
        with monkeypatch.context() as patch:
            patch.setattr(RunClock, "time_left", property(lambda clock, end=end: end - clock.state.iteration))
            trained = train(job(f"early_{end}", asked, minutes=1.0), silent)
        assert trained.iterations == end and trained.moves == moves
    still = train(job("still", replace(SHORT, iterations=2, static_fraction=0.99)), silent)
    assert still.moves  # as it was asked for
    quiet = job("quasi_static", asked, minutes=1.0)
    quiet = replace(quiet, model=replace(quiet.model, scheme="quasi_static"))
    with monkeypatch.context() as patch:
        patch.setattr(RunClock, "time_left", property(lambda clock: 3 - clock.state.iteration))
        assert train(quiet, silent).moves  # all that it can


@pytest.mark.parametrize("resume", [False, True])
def test_a_process_group_has_no_minutes(job, resume):  # noqa: F811
    """Each process would end by a clock of its own, and the others wait for it."""
    with pytest.raises(SsilkError, match="minutes for a group of processes; its clocks differ; set the iterations"):
        TrainingRun(job("group", minutes=1.0, resume=resume), silent, ProcessGroup(0, 2))


def test_time_is_up_when_no_validation_fits_any_more(job, monkeypatch):  # noqa: F811
    monkeypatch.setattr(clock, "fitting_iterations", lambda *_: 13)
    monkeypatch.setattr(budget, "MIN_ITERATIONS", 1)
    run = TrainingRun(job("clock", minutes=1.0), silent)
    now = run.clock.began
    monkeypatch.setattr(training.time, "monotonic", lambda: now)
    run.clock.validation_seconds = 10.0
    for spent in (49.0, 51.0):
        now = run.clock.began + spent
        assert run.clock.time_left == pytest.approx(50.0 - spent)
    assert TrainingRun(job("endless"), silent).clock.time_left == inf


def test_a_run_that_is_done_goes_on_with_more_minutes_alone(job, monkeypatch):  # noqa: F811
    monkeypatch.setattr(training, "timed_pace", lambda *_: Pace(1.0, 1.0))
    now = [0.0]
    monkeypatch.setattr(training.time, "monotonic", lambda: now[0])
    real = TrainingRun.step

    def step(run: TrainingRun) -> None:
        real(run)
        now[0] += 1.0

    monkeypatch.setattr(TrainingRun, "step", step)
    first = train(job("more", minutes=0.5), silent).iterations
    assert 25 <= first <= 30
    assert train(job("more", minutes=0.5, resume=True), silent).iterations == first
    assert train(job("more", minutes=1.0, resume=True), silent).iterations > first + 20


def test_time_that_ends_with_static_training_is_no_error():
    assert scale_schedule(PLAN, 300, static=300).static_iterations in (299, 300)
