# SPDX-License-Identifier: Apache-2.0
"""Training for a given wall time: scale the schedule to the iterations that fit."""

from __future__ import annotations

import time
from dataclasses import replace

import torch

from ..config import TrainConfig
from ..errors import fail
from .step import EAGER_STEPS, Stepper

PLANNED_SHARE = 0.9  # of the remaining time; the rest is a reserve in case the machine slows down
TIMED_STEPS = 3  # in each phase
MIN_ITERATIONS = 20  # fewer do not train a usable model
MAX_EMA_DECAY = 0.99999


def scale_schedule(config: TrainConfig, iterations: int) -> TrainConfig:
    """Return the schedule stretched to so many iterations, with the same number of validations."""
    factor = iterations / config.iterations
    return replace(
        config,
        iterations=iterations,
        learning_rate_warmup=round(config.learning_rate_warmup * factor),
        validate_every=max(1, round(config.validate_every * factor)),
        ema_decay=min(MAX_EMA_DECAY, config.ema_decay ** (1 / factor)),
    )


def fitting_iterations(stepper: Stepper, config: TrainConfig, seconds: float, scoring: float, where: str) -> int:
    """Return how many iterations of a schedule fit into the remaining time.

    Args:
        stepper: of the same schedule; a few steps are timed, after which it must not be used.
        seconds: remaining time [s].
        scoring: duration of a validation [s].
        where: name of the run for messages.

    Raises:
        SsilkError: fewer than `MIN_ITERATIONS` fit.
    """
    validations = int((1 - config.static_fraction) * config.iterations / config.validate_every) + 1
    static, dynamic = (_seconds(stepper, iteration) for iteration in (0, config.static_iterations))
    left = PLANNED_SHARE * seconds - validations * scoring
    count = int(left / (config.static_fraction * static + (1 - config.static_fraction) * dynamic))
    if not count >= MIN_ITERATIONS:
        fail(
            where,
            f"{max(0, count)} iterations fit into the remaining minutes on this device",
            f"at least {MIN_ITERATIONS} are needed",
            "give more minutes, or use a smaller preset",
        )
    return count


def _seconds(stepper: Stepper, iteration: int) -> float:
    """Return the duration of a step in the phase of an iteration [s]."""
    for _ in range(EAGER_STEPS + 1 if stepper.device.type == "cuda" else 1):  # includes graph capture
        stepper.run(iteration)
    began = _clock(stepper.device)
    for _ in range(TIMED_STEPS):
        stepper.run(iteration)
    return (_clock(stepper.device) - began) / TIMED_STEPS


def _clock(device: torch.device) -> float:
    """Return the time after synchronising with the device [s]."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.monotonic()
