# SPDX-License-Identifier: Apache-2.0
"""Steps and validations before those that are timed: the first ones load or compile what the others find ready."""

from __future__ import annotations

from dataclasses import replace

from ..network.model.network import GarmentModel
from .parts import TrainingParts
from .settings import TrainConfig

VALIDATED_FRAMES = 4


def compile_loops(parts: TrainingParts, config: TrainConfig) -> None:
    """Do the smallest step of each phase and a short validation; the model is restored afterwards.

    The first of each on a machine compiles loops (`physics.loops`), which takes seconds that no later one takes.
    """
    model = parts.model
    before = {name: value.clone() for name, value in model.state_dict().items()}
    stepper = parts.stepper(replace(config, batch=1, pretraining_batch=1, static_batch=1), config.seed)
    for iteration in {0, config.static_iterations}:
        stepper.run(iteration)
    model.load_state_dict(before)
    try_validation(parts, model)


def try_validation(parts: TrainingParts, model: GarmentModel | None = None) -> None:
    """Validate a few frames of a model, or of linear blend skinning without one."""
    parts.validator.frame_terms(parts.validator.clips[0][:VALIDATED_FRAMES], model)
