# SPDX-License-Identifier: Apache-2.0
"""The batch of a training: as large as asked for, or as memory allows."""

from __future__ import annotations

from dataclasses import replace

import torch

from ..errors import fail
from ..events import Message, Reporter
from .budget import check_estimate
from .clock import RunClock
from .job import TrainJob
from .memory import StepMemory, decoded_frames, free_memory
from .parallel import ProcessGroup
from .parts import TrainingParts
from .settings import TrainConfig
from .state import ReducedSettings


def need_enough_minutes(job: TrainJob, config: TrainConfig, device: torch.device) -> None:
    """Refuse minutes that the estimate does not allow, before anything is built.

    The whole body is counted, so that the batch is no larger than the one that `FittingBatch.fit` finds.

    Raises:
        SsilkError: too few iterations would fit.
    """
    assert job.minutes is not None
    body = job.scene.character.merged_body().mesh.vertex_count
    body += 2 * sum(one.file.scene.garment.mesh.vertex_count for one in job.over)
    memory = StepMemory.of(job.scene, job.model, config, job.fabric, body)
    batch, poses = memory.fitting_batch(config, free_memory(device))
    fitting = replace(config, batch=batch, pretraining_batch=poses)
    check_estimate(fitting, memory.samples, device.type, 60 * job.minutes, str(job.output))


class FittingBatch:
    """Reduces the batch of a run to what fits into memory, and tells it.

    Args:
        clock: of the run, whose schedule has the batch, and whose state keeps what was reduced.
    """

    def __init__(
        self,
        clock: RunClock,
        parts: TrainingParts,
        device: torch.device,
        group: ProcessGroup,
        report: Reporter,
    ) -> None:
        self.clock, self.parts, self.device, self.group, self.report = clock, parts, device, group, report

    @property
    def memory(self) -> int:
        """The predicted memory of a step in this process [bytes]."""
        own = self.group.local_config(self.clock.schedule)
        return self._of_a_step.needed(decoded_frames(own, own.batch))

    def fit(self) -> None:
        """Reduce the batch until the predicted memory fits, and report it.

        Raises:
            SsilkError: one window does not fit.
        """
        config, group, free = self.clock.job.train, self.group, free_memory(self.device)
        if self.device.type == "cpu":
            free //= group.size
        self._of_a_step.check_one_window_fits(config, free)
        fitting = group.gather(self._of_a_step.fitting_batch(group.local_config(config), free))
        batch, poses = (group.size * min(counts) for counts in zip(*fitting))
        if (batch, poses) != (config.batch, config.pretraining_batch):
            found = f"{self.memory / 2**30:.1f} GiB needed, {free / 2**30:.1f} GiB free on {self.device}"
            self._reduce(found, batch, poses)

    def halve(self) -> None:
        """Halve the batch, since the device is out of memory, and report it.

        Raises:
            SsilkError: a batch of one does not fit, or other processes train with the same batch.
        """
        config, iteration = self.clock.schedule, self.clock.state.iteration
        garment, found = (
            self.clock.job.scene.garment.mesh.path,
            f"iteration {iteration}: {self.device} is out of memory",
        )
        if self.group.size != 1:
            fail(
                garment,
                found,
                "a group of processes cannot change its batch",
                "train again with a smaller one (--set batch=...)",
            )
        if not (config.pretraining_batch if iteration < config.static_iterations else config.batch) > 1:
            fail(
                garment,
                f"{found} with a batch of one",
                "a step needs more memory than is free",
                "use another device, or shorter windows (--set window=...)",
            )
        self._reduce(found, max(1, config.batch // 2), max(1, config.pretraining_batch // 2))

    @property
    def _of_a_step(self) -> StepMemory:
        job, parts, energy = self.clock.job, self.parts, self.parts.energy
        samples, stitches = len(energy.cloth.samples.area), len(energy.stitching or ())
        contours = parts.validator.contours is not None
        # Normals of cloth are computed anew in each frame, from its triangles.
        met = parts.reached + (2 * parts.inner.vertex_count if parts.inner else 0)
        return StepMemory(job.scene, job.model, met, samples, stitches, contours=contours)

    def _reduce(self, found: str, batch: int, pretraining_batch: int) -> None:
        before, state = self.clock.schedule, self.clock.state
        pace = state.lowered[-1].pace if state.lowered else 1.0
        state.lowered.append(ReducedSettings(state.iteration, batch, pretraining_batch, pace))
        self.report(
            Message(
                f"{found}: the batch is reduced from {before.batch} to {batch} windows and from "
                f"{before.pretraining_batch} to {pretraining_batch} single poses.",
                "warning",
            )
        )
