# SPDX-License-Identifier: Apache-2.0
"""The training run of a baseline, for a number of iterations or for a time, with the files of `training.run`."""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any

import torch

from ssilk_core.devices import select_device
from ssilk_core.errors import fail
from ssilk_core.events import Checkpoint, Message, Progress, Reporter, Started
from ssilk_core.training.curve import CurvePoint, append_point
from ssilk_core.training.job import TrainJob
from ssilk_core.training.parts import build_parts
from ssilk_core.training.run_files import RunFiles
from ssilk_core.training.state import Best, RunState, load_state, restore
from ssilk_core.training.validation import Score
from ssilk_core.training.verdict import non_finite_terms, validation_message

from .descriptors import joint_bank
from .files import save_baseline
from .networks import BaselineConfig, baseline
from .training import BaselineObjective, BaselineStepper


@dataclass(frozen=True, kw_only=True)
class BaselineJob:
    """The inputs of a baseline's training.

    Attributes:
        base: scene, motions, fabric and schedule. The batch is never lowered.
        config: what is trained.
        judged, mixed: as in `training.BaselineObjective`.
        seconds: time for all steps together, without validations [s]; where it is finite, the schedule ends with
            it rather than with the iterations.
    """

    base: TrainJob
    config: BaselineConfig
    judged: int = 2
    mixed: float = 0.0
    seconds: float = math.inf

    def identity(self) -> dict[str, Any]:
        """Return what makes a run the run it is; a resumed run must be asked the same."""
        limit = self.seconds if math.isfinite(self.seconds) else None
        own = {"baseline": asdict(self.config), "judged": self.judged, "mixed": self.mixed, "limit [s]": limit}
        return {**self.base.identity(), **own}


class BaselineRun:
    """A run, new or resumed.

    Attributes:
        state: what changes while the run goes on.
        batch: energies of the last batch before a validation [J].
        iterations: steps to do in all; with a limit in time an estimate, made anew at each validation.
    """

    def __init__(self, job: BaselineJob, report: Reporter) -> None:
        self.job, self.report, base = job, report, job.base
        device = select_device(base.device)
        self.files = RunFiles(base, device)
        self.files.remove_unfinished()
        parts = build_parts(replace(base, train=replace(base.train, shape_smoothing=0.0)), device)
        joints = parts.model.joints
        inner = torch.as_tensor(base.scene.character.skeleton.parents[joints] >= 0, device=device)
        bank, held = (joint_bank(bank, inner, job.config.fps) for bank in (parts.bank, parts.validator.bank))
        self.validator, parts.validator.bank = parts.validator, held
        self.model = baseline(base.scene, job.config, joints, base.train.seed).to(device)
        surface = base.train.closest_point == "triangles"
        objective = BaselineObjective(
            self.model, parts.energy, parts.body, bank, surface, judged=job.judged, mixed=job.mixed
        )
        self.stepper = BaselineStepper(objective, base.train, torch.Generator(device).manual_seed(base.train.seed))
        self.iterations = base.train.iterations
        self.state, self.batch = RunState(job.identity()), dict[str, float]()
        if base.resume:
            self._resume()
        parameters = sum(value.numel() for value in self.model.parameters())
        shared = {name: value for name, value in parts.detail().items() if name not in ("proxies", "blendshapes")}
        report(Started(job.config.method, self.iterations, {**shared, "parameters": parameters}))

    @cached_property
    def lbs(self) -> Score:
        """Score of linear blend skinning."""
        return self.validator.lbs_score()

    def _resume(self) -> None:
        self.state, tensors = load_state(self.files.state, self.state.asked)
        restore(self.files.state, self.stepper, tensors)
        self.stepper.skipped.count.fill_(self.state.skipped)
        self._plan(self.state.seconds / self.state.iteration)

    def _plan(self, each: float) -> None:
        """Let the schedule end with the time, when a step takes `each` [s]."""
        if math.isfinite(self.job.seconds):
            left = max(0.0, self.job.seconds - self.state.seconds)
            self.iterations = self.state.iteration + int(left / each)
            self.stepper.config = replace(self.stepper.config, iterations=max(1, self.iterations))

    def advance(self) -> None:
        """Do the steps up to the next validation."""
        state, every = self.state, self.job.base.train.validate_every
        began, first = time.monotonic(), state.iteration
        state.iteration = min(self.iterations, (first // every + 1) * every)
        for iteration in range(first, state.iteration):
            self.stepper.run(iteration)
        self.batch = {name: float(value) for name, value in self.stepper.terms.items()}  # waits for the device
        taken = time.monotonic() - began
        state.seconds += taken
        if state.iteration < self.iterations:  # or a few more steps would follow the end of the schedule
            self._plan(taken / (state.iteration - first))
        left = (self.iterations - state.iteration) * taken / (state.iteration - first)
        self.report(Progress(state.iteration, max(self.iterations, state.iteration), left, self.batch))

    def validate(self) -> None:
        """Score the averaged network on the held-out clips, and keep it when it is the best so far.

        Raises:
            SsilkError: the score is not finite.
        """
        state, base = self.state, self.job.base
        score = self.validator.score(self.stepper.ema_model)
        broken = " and ".join(non_finite_terms(score))
        if broken:
            fail(
                str(base.output),
                f"{broken} not finite at iteration {state.iteration}",
                "the best model before it is kept",
                "train again with smaller steps (--set learning_rate=...)",
            )
        self.report(validation_message(state.iteration, score, self.lbs, base.scene.rig.proxy_count > 0))
        finite = {name: value for name, value in self.batch.items() if math.isfinite(value)}
        state.curve = append_point(state.curve, CurvePoint(state.iteration, state.seconds, finite, score))
        state.skipped = int(self.stepper.skipped.count)
        if state.best is None or score.total < state.best.score.total:
            state.best = Best(state.iteration, score)
            save_baseline(
                base.output, self.stepper.ema_model, base.fabric, self.files.provenance(state, score, self.lbs)
            )
            self.report(Checkpoint(str(base.output), state.iteration, True))
        self.files.save_state(self.stepper, state)
        self.files.save_curve(state, self.lbs)


def train_baseline(job: BaselineJob, report: Reporter) -> RunState:
    """Train a baseline and keep the best of it on disk, its state and learning curve beside it; return the state.

    Raises:
        SsilkError: the inputs do not suffice, or training diverged.
    """
    run = BaselineRun(job, report)
    while run.state.iteration < run.iterations:
        run.advance()
        run.validate()
    if run.state.skipped:
        report(Message(f"{run.state.skipped} steps in total were skipped.", "warning"))
    return run.state
