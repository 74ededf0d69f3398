# SPDX-License-Identifier: Apache-2.0
"""How long a training will take, from measurements on devices of the same kind."""

from __future__ import annotations

import importlib.util

from .settings import TrainConfig

# Seconds per contact sample and frame in a complete optimiser step, and per step: a cape of 7,900 samples on two CPU
# threads beside other programs, validations included ("draft", with `physics.loops` or without), four garments of
# 7,300 to 10,000 on a GPU that trained two at once. A GPU's small steps take as long as their launches. Only measured
# devices are listed.
SECONDS_PER_SAMPLE = {"cpu": 5e-7 if importlib.util.find_spec("numba") else 2.6e-6, "cuda": 0.9e-9}
SECONDS_PER_STEP = {"cpu": 0.0, "cuda": 8e-3}


def training_seconds(samples: int, train: TrainConfig, device: str) -> float | None:
    """Return the estimated duration of a training [s]; None for a device that has not been measured.

    Args:
        samples: at which the garment meets the body (`physics.samples`).
    """
    if device not in SECONDS_PER_SAMPLE:
        return None
    static = step_seconds(samples, train.pretraining_batch, device)
    dynamic = step_seconds(samples, trained_frames(train), device)
    return train.static_iterations * static + (train.iterations - train.static_iterations) * dynamic


def step_seconds(samples: int, frames: int, device: str) -> float:
    """Return the estimated duration of a step on so many frames [s], on a device that has been measured."""
    return SECONDS_PER_SAMPLE[device] * samples * frames + SECONDS_PER_STEP[device]


def trained_frames(train: TrainConfig) -> int:
    """Return the frames of a step of dynamic training; the two given ones of each window count if they are fitted."""
    return train.batch * (train.window if train.initial_loss else train.window - 2) + train.static_batch
