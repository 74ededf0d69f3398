# SPDX-License-Identifier: Apache-2.0
"""Training for a given wall time: the schedule follows the clock.

A few timed steps give the first plan. The speed is measured again while training runs, and the plan follows it: on a
machine that slows down there are fewer iterations, and the learning rate is low in the end all the same.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import ceil

import torch

from ..errors import fail
from ..events import format_count
from .prediction import SECONDS_PER_SAMPLE, step_seconds, trained_frames
from .settings import MOST_OF_ALL, TrainConfig
from .step import EAGER_STEPS, Stepper

PLANNED_SHARE = 0.98  # of the remaining time
VALIDATION_SHARE = 0.1  # of the time that validations may take at most
TIMED_STEPS = 3  # in each phase
MIN_ITERATIONS = 20  # fewer do not train a usable model
CAUTION = 0.5  # of the expected duration of a phase that is not timed yet
ESTIMATE_CAUTION = 0.25  # of the preflight's estimate, which was measured on another machine
LONG_STEP = 5.0  # [s] of a first step on a processor, above which no other is timed: what first steps do takes less
SMOOTHING = 0.3  # weight of a new measurement of the speed


@dataclass(frozen=True)
class Pace:
    """Duration of a step of static and of dynamic training [s]."""

    static: float
    dynamic: float

    def updated(self, measured: float, is_static: bool) -> Pace:
        """Return the pace after a step of one phase took `measured` seconds; the other phase slows down as much."""
        known = self.static if is_static else self.dynamic
        factor = 1 + SMOOTHING * (measured / known - 1)
        return Pace(factor * self.static, factor * self.dynamic)


def scale_schedule(config: TrainConfig, iterations: int, static: int = 0, validations: int = 0) -> TrainConfig:
    """Return the schedule stretched to so many iterations.

    Args:
        static: iterations of static training, where these are over; zero for the schedule's share.
        validations: how many there are; zero for as many as in the schedule.
    """
    factor = iterations / config.iterations
    every = config.validate_every * factor
    if validations:
        every = iterations / validations
    return replace(
        config,
        iterations=iterations,
        static_fraction=min(MOST_OF_ALL, (static + 0.5) / iterations) if static else config.static_fraction,
        learning_rate_warmup=round(config.learning_rate_warmup * factor),
        validate_every=max(1, round(every)),
        ema_decay=min(MOST_OF_ALL, config.ema_decay ** (1 / factor)),
    )


def affordable_validations(config: TrainConfig, seconds: float, scoring: float) -> int:
    """Return how many validations a run of so many seconds has, each of `scoring` seconds; at least one."""
    asked = int(config.iterations / config.validate_every) + 1
    return max(1, min(asked, int(VALIDATION_SHARE * seconds / scoring))) if scoring > 0 else asked


def timed_pace(stepper: Stepper, config: TrainConfig, check: Callable[[Pace], object] = lambda _: None) -> Pace:
    """Time a few steps of each phase; the stepper must not be used afterwards.

    Args:
        check: called after any step with the pace so far: the other phase is expected to take `CAUTION` of what its
            frames do.
    """
    frames = config.pretraining_batch, trained_frames(config)

    def check_static(seconds: float) -> None:
        check(Pace(seconds, CAUTION * seconds * frames[1] / frames[0]))

    def check_dynamic(seconds: float) -> None:
        check(Pace(static or seconds, seconds))

    static = _seconds(stepper, 0, check_static) if config.static_iterations else 0.0
    dynamic = _seconds(stepper, config.static_iterations, check_dynamic)
    return Pace(static or dynamic, dynamic)


def check_possible(pace: Pace, config: TrainConfig, seconds: float, where: str) -> None:
    """Raise `SsilkError` if too few iterations of a new run, named `where`, fit into so many seconds at a pace.

    It says what a step takes, and how many more minutes would do.
    """
    iterations = max(0, fitting_iterations(pace, config, seconds))
    if not iterations >= MIN_ITERATIONS:
        share = config.static_fraction
        each = share * pace.static + (1 - share) * pace.dynamic
        lacking = MIN_ITERATIONS * each / PLANNED_SHARE - max(0.0, seconds)
        fail(
            where,
            f"at most {iterations} iterations fit into the remaining minutes, since a step takes about {each:.2g} s "
            "on this device",
            f"at least {MIN_ITERATIONS} are needed",
            f"give at least {format_count(ceil(lacking / 60), 'more minutes')}, or use a smaller preset",
        )


def fitting_iterations(pace: Pace, config: TrainConfig, seconds: float, done: int = 0) -> int:
    """Return the iterations of a schedule of which `done` are over, where the others take at most so many seconds."""
    left, share = PLANNED_SHARE * seconds, config.static_fraction
    if done >= config.static_iterations:
        return done + int(left / pace.dynamic)
    return int((left + done * pace.static) / (share * pace.static + (1 - share) * pace.dynamic))


def check_estimate(config: TrainConfig, samples: int, device: str, seconds: float, where: str) -> None:
    """Raise `SsilkError` if the estimate of the preflight for so many contact samples leaves too little time [s].

    More threads than those of the estimate are expected to take less time in proportion.
    """
    if device in SECONDS_PER_SAMPLE:
        threads = max(2, torch.get_num_threads()) / 2 if device == "cpu" else 1
        frames = config.pretraining_batch, trained_frames(config)
        each = (ESTIMATE_CAUTION * step_seconds(samples, count, device) / threads for count in frames)
        check_possible(Pace(*each), config, seconds, where)


def _seconds(stepper: Stepper, iteration: int, check: Callable[[float], None]) -> float:
    """Return the duration of a step in the phase of an iteration [s]; call `check` with it as soon as it is known."""
    began = _clock(stepper.device)
    for _ in range(EAGER_STEPS + 1 if stepper.device.type == "cuda" else 1):  # includes graph capture
        stepper.run(iteration)
    first = _clock(stepper.device) - began
    if first > LONG_STEP and stepper.device.type == "cpu":
        check(first)
        return first
    began = _clock(stepper.device)
    for _ in range(TIMED_STEPS):
        stepper.run(iteration)
    each = (_clock(stepper.device) - began) / TIMED_STEPS
    check(each)
    return each


def _clock(device: torch.device) -> float:
    """Return the time after synchronising with the device [s]."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.monotonic()
