# SPDX-License-Identifier: Apache-2.0
"""The files of a training run: best model, state to resume from, learning curve, non-finite step."""

from __future__ import annotations

import platform
from dataclasses import asdict
from typing import Any

import torch

from .. import __version__
from ..devices import device_name
from ..files import remove_unfinished
from ..network.checkpoint import model_file, save_model
from ..network.model.network import GarmentModel
from ..physics.intersections.pairs import libigl_version
from .curve import curve_path, summary, write_curve
from .divergence import fault_path, save_fault
from .job import TrainJob
from .parallel import SINGLE_PROCESS, ProcessGroup
from .state import RunState, copy_to_cpu, json_round_trip, save_state, state_path
from .step import Stepper
from .validation import Score
from .verdict import is_worse


class RunFiles:
    """Writes the files of one run, in its model's folder; in a group, only the first process writes."""

    def __init__(self, job: TrainJob, device: torch.device, group: ProcessGroup = SINGLE_PROCESS) -> None:
        self.job, self.device, self.group = job, device, group
        self.model, self.state = job.output, state_path(job.output)
        self.curve, self.fault = curve_path(job.output), fault_path(job.output)

    def remove_unfinished(self) -> None:
        """Remove partial files of a run that was killed while it wrote."""
        if self.group.is_first:
            for path in (self.model, self.state, self.curve, self.fault):
                remove_unfinished(path)

    def save_state(self, stepper: Stepper, state: RunState) -> None:
        """Write the state; all processes of a group must call this."""
        samplers = self.group.gather(copy_to_cpu(stepper.sampler.state()))
        if self.group.is_first:
            save_state(self.state, stepper, samplers, state)
        self.group.gather(None)  # no process continues before the file exists

    def save_curve(self, state: RunState, lbs: Score) -> None:
        """Write the learning curve of the state."""
        if self.group.is_first:
            write_curve(self.curve, state.curve, lbs)

    def save_model(self, model: GarmentModel, state: RunState, score: Score, lbs: Score) -> None:
        """Write a model with its provenance."""
        if self.group.is_first:
            provenance = self.provenance(state, score, lbs)
            save_model(self.model, model_file(model, self.job.fabric, provenance, self.job.fabrics))

    def save_fault(self, stepper: Stepper, found: str) -> None:
        """Write the inputs of the last skipped step."""
        if self.group.is_first:
            save_fault(self.fault, stepper, self.job.training_motions(), found)

    def provenance(self, state: RunState, score: Score, lbs: Score) -> dict[str, Any]:
        """Return the provenance of a model: inputs, settings, versions, validation, and that of its base."""
        return json_round_trip(
            {
                **state.asked,
                "iteration": state.iteration,
                "planned": state.planned,
                "lowered": [asdict(item) for item in state.lowered],
                **({"bodies": self.job.family.bodies.names} if self.job.family else {}),
                "seed": self.job.train.seed,
                "ssilk": __version__,
                "torch": torch.__version__,
                "libigl": libigl_version(),
                "python": platform.python_version(),
                "device": device_name(self.device),
                "validation": summary(score),
                "lbs": summary(lbs),
                "worse_than_lbs": is_worse(score, lbs),
                **({"base": self.job.base.provenance, "whole": self.job.whole} if self.job.base else {}),
            }
        )
