# SPDX-License-Identifier: Apache-2.0
"""Steps before a run whose minutes are planned by the time of its steps."""

from __future__ import annotations

from dataclasses import replace

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
    clip = parts.validator.clips[0]
    parts.validator.frame_terms(clip[:VALIDATED_FRAMES], model)
