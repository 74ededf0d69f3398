# SPDX-License-Identifier: Apache-2.0
"""Training for a given wall time: scale the schedule to the iterations that fit."""

from __future__ import annotations

import time
from dataclasses import replace

import torch

from ..config import TrainConfig
from ..errors import fail
from .step import EAGER_STEPS, Stepper

SHARE = 0.9  # of the time that is left, for which iterations are planned; the rest is for a machine that slows down
TIMED = 3  # steps of each phase
FEWEST = 20  # iterations below which nothing is learned
SLOWEST_AVERAGE = 0.99999


def shaped(config: TrainConfig, iterations: int) -> TrainConfig:
    """Return a schedule stretched to so many iterations, with as many validations, averaging over the same share."""
    factor = iterations / config.iterations
    return replace(
        config,
        iterations=iterations,
        learning_rate_warmup=round(config.learning_rate_warmup * factor),
        validate_every=max(1, round(config.validate_every * factor)),
        ema_decay=min(SLOWEST_AVERAGE, config.ema_decay ** (1 / factor)),
    )


def fitting_iterations(stepper: Stepper, config: TrainConfig, seconds: float, scoring: float, where: str) -> int:
    """Return how many iterations of a schedule fit into a time.

    Args:
        stepper: of the same schedule; it is stepped a few times, and of no use afterwards.
        seconds: that are left [s].
        scoring: how long a validation takes [s].
        where: whose training it is.

    Raises:
        SsilkError: hardly any fit.
    """
    validations = int((1 - config.static_fraction) * config.iterations / config.validate_every) + 1
    warm, proper = (_seconds(stepper, iteration) for iteration in (0, config.static_iterations))
    left = SHARE * seconds - validations * scoring
    count = int(left / (config.static_fraction * warm + (1 - config.static_fraction) * proper))
    if not count >= FEWEST:
        fail(
            where,
            f"{max(0, count)} iterations fit into the minutes that are left on this device",
            f"at least {FEWEST} are needed",
            "give more minutes, or take a smaller preset",
        )
    return count


def _seconds(stepper: Stepper, iteration: int) -> float:
    """Return how long a step of the phase of an iteration takes."""
    for _ in range(EAGER_STEPS + 1 if stepper.device.type == "cuda" else 1):  # with the capture of a graph
        stepper.run(iteration)
    began = _clock(stepper.device)
    for _ in range(TIMED):
        stepper.run(iteration)
    return (_clock(stepper.device) - began) / TIMED


def _clock(device: torch.device) -> float:
    """Return the time when the device has done all that it was given [s]."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.monotonic()
