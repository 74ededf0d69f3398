# SPDX-License-Identifier: Apache-2.0
"""The wall time of a training run, and the plan of its iterations that follows it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from math import ceil, inf

from .budget import Pace, affordable_validations, check_possible, fitting_iterations, scale_schedule
from .job import TrainJob
from .prediction import trained_frames
from .settings import TrainConfig
from .state import RunState
from .step_times import StepTimes

PACE_INTERVAL = 5.0  # [s] between measurements of the speed on a processor
OF_A_MODEL = 1.5  # duration of a model's validation over that of linear blend skinning, until one was measured
LONG_STATIC = 5.0  # [s] of static training, from which on the steps that come after it are timed ahead
MORE_TIME = 0.1  # of the minutes: what has to be left for a run that is done to go on


class RunClock:
    """Measures a run and, where it has minutes, plans as many iterations as fit.

    Args:
        began: when the process began, as `time.monotonic` tells it [s].

    Attributes:
        job: whose minutes and schedule count.
        state: of the run; its times and its plan are kept up to date.
        began: when the run began, as if it had not been interrupted [s].
        validation_seconds: approximate duration of a validation [s].
        pace: None until there is a plan.
    """

    def __init__(self, job: TrainJob, state: RunState, began: float) -> None:
        self.job, self.state = job, state
        self.began = began - max(state.wall, state.seconds)
        self.validation_seconds = 0.0
        self._validated = False
        self.pace: Pace | None = None
        self._times = StepTimes(trained_frames(job.train) / job.train.pretraining_batch)
        self._foreseen = False  # whether that ratio was measured
        self.start()

    @property
    def schedule(self) -> TrainConfig:
        """The schedule in use: as requested, scaled to the plan, with reduced settings."""
        state, config = self.state, self.job.train
        if state.planned:
            config = scale_schedule(config, state.planned, state.static, state.validations)
        return state.lowered[-1].apply_to(config) if state.lowered else config

    @property
    def wall(self) -> float:
        """Wall time of the run [s]; training before a resumption counts."""
        return time.monotonic() - self.began

    @property
    def time_left(self) -> float:
        """Time left before a last validation [s]."""
        return inf if self.job.minutes is None else 60 * self.job.minutes - self.wall - self.validation_seconds

    def training_time_left(self) -> float:
        """Return the time left for steps [s], after the validations that are still to come."""
        to_come = max(0, self.state.validations - len(self.state.curve) - 1)  # the last is left out of `time_left`
        return max(0.0, self.time_left - to_come * self.validation_seconds)

    def scored_lbs(self, seconds: float) -> None:
        """Take in how long the validation of linear blend skinning took; a model is measured at more length."""
        self.validation_seconds = OF_A_MODEL * seconds

    def validated(self, seconds: float) -> None:
        """Take in how long the validation of a model took; of those that are planned, only what it leaves stay."""
        self.validation_seconds = max(self.validation_seconds, seconds) if self._validated else seconds
        self._validated, state = True, self.state
        if state.validations and self.job.minutes:
            most = affordable_validations(self.job.train, 60 * self.job.minutes, self.validation_seconds)
            state.validations = min(state.validations, max(most, len(state.curve) + 1))

    @property
    def has_moved(self) -> bool:
        """Whether steps of dynamic training were done, where any are asked for."""
        state, asked = self.state, self.job.train
        if self.job.model.scheme == "quasi_static" or asked.static_iterations >= asked.iterations:
            return True
        return state.iteration > (state.static or self.schedule.static_iterations)

    def stepped(self) -> None:
        """Take in that a step is done; on a GPU, perhaps only launched."""
        iteration = self.state.iteration
        is_static = iteration <= self.schedule.static_iterations
        self._times.took(is_static, iteration, self.state.seconds + time.monotonic() - self._since)

    @property
    def lacks_dynamic(self) -> bool:
        """Whether long static training has told what its steps take, and nothing has told that of dynamic ones."""
        each, config = self._times.static, self.schedule
        known = self._foreseen or self.pace is not None or config.static_iterations >= config.iterations
        return each is not None and not known and each * config.static_iterations > LONG_STATIC

    def foresee(self, pace: Pace) -> None:
        """Take in how long steps take that were timed ahead, both kinds in one moment, for what dynamic ones will."""
        self._foreseen = True
        if pace.static and pace.dynamic:
            self._times.ratio = pace.dynamic / pace.static

    def seconds_left(self) -> float | None:
        """Return how long the run still takes, with its validations [s]; None while nothing is known."""
        state, config = self.state, self.schedule
        if self.pace:
            self._times.ratio = self.pace.dynamic / self.pace.static
        static = max(0, config.static_iterations - state.iteration)
        left = self._times.left(static, max(0, config.iterations - state.iteration - static))
        if left is None:
            return None
        every, last = config.validate_every, state.curve[-1].iteration if state.curve else 0
        to_come = max(0, ceil(config.iterations / every) - last // every - 1)  # without the one at the end
        if state.validations:
            to_come = max(0, state.validations - len(state.curve) - 1)
        left += to_come * self.validation_seconds
        return min(left, max(0.0, self.time_left)) + self.validation_seconds

    def plan(self, pace: Pace, minutes: float) -> None:
        """Plan a new run of so many minutes at a pace.

        Raises:
            SsilkError: too few iterations fit.
        """
        state, config = self.state, self.schedule
        self.pace = pace
        state.validations = affordable_validations(config, 60 * minutes, self.validation_seconds)
        left = self.training_time_left()
        check_possible(pace, config, left, str(self.job.output))
        state.planned = fitting_iterations(pace, config, left)

    def plan_rest(self, minutes: float) -> None:
        """Plan the rest of a resumed run; one that is done goes on where much more time is left."""
        state = self.state
        if not (state.seconds and state.iteration):
            return
        each = state.seconds / state.iteration
        self.pace = Pace(*(state.pace or [each, each]))
        left = self.training_time_left()
        if not state.validations:
            state.validations = affordable_validations(self.job.train, 60 * minutes, self.validation_seconds)
        if state.iteration != state.planned or left > MORE_TIME * 60 * minutes:
            self._follow(self.pace)

    def start(self) -> None:
        """Measure steps from now on."""
        self._since = self._measured_at = time.monotonic()
        self._measured = self.state.iteration, self.state.seconds

    @property
    def measurement_due(self) -> bool:
        """Whether the speed was not measured for long."""
        return time.monotonic() - self._measured_at >= PACE_INTERVAL

    def measure(self) -> None:
        """Measure the speed since the last measurement, and plan again, where there is a plan."""
        if self.pace is None:
            return
        iteration, seconds = self.state.iteration, self.state.seconds + time.monotonic() - self._since
        steps, took = iteration - self._measured[0], seconds - self._measured[1]
        self._measured, self._measured_at = (iteration, seconds), time.monotonic()
        if steps > 0 and took > 0:
            self.pace = self.pace.updated(took / steps, iteration <= self.schedule.static_iterations)
            self.state.pace = [self.pace.static, self.pace.dynamic]
            self._follow(self.pace)

    def _follow(self, pace: Pace) -> None:
        """Plan as many iterations as fit into the time that is left."""
        state, config = self.state, self.schedule
        if state.iteration >= config.static_iterations:
            state.static = config.static_iterations
        found = fitting_iterations(pace, config, self.training_time_left(), state.iteration)
        state.planned = max(found, state.iteration, 1)

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Exclude the time within from the seconds of training."""
        self.state.seconds += time.monotonic() - self._since
        try:
            yield
        finally:
            self._since = time.monotonic()
