# SPDX-License-Identifier: Apache-2.0
"""A training run: from a scene and motions to a model file (paper, Section 3.7)."""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from math import inf, isfinite
from typing import NoReturn

import torch
from torch import Tensor

from ..config import TrainConfig
from ..devices import chosen_device
from ..errors import fail
from ..events import Checkpoint, Message, Progress, Reporter, Started
from ..kinematics import split_at_cuts
from ..memory import decoded_frames, fitting_batch, free_memory, need_one_window, step_memory, suffices
from ..motion_bank import MOST_TURN
from .budget import fitting_iterations, shaped
from .curve import CurvePoint, with_point
from .divergence import EVERY, SPAN, DivergenceMonitor
from .job import TrainJob
from .parallel import SINGLE_PROCESS, ProcessGroup
from .parts import build_parts
from .run_files import RunFiles
from .state import Best, Lowered, RunState, learned, load_state, restore, restore_learned
from .validation import Score
from .verdict import not_finite, verdict

SAVE_EVERY = 60.0  # [s] that a killed process loses at most, a step and a validation aside
SLOWER = 0.25  # factor on the step sizes once training has not stayed finite


@dataclass(frozen=True)
class TrainingResult:
    """How a run ended: `finished` is False when it was interrupted; `score` is that of the best model kept."""

    finished: bool
    iterations: int
    score: Score
    lbs: Score


class TrainingRun:
    """A training run that has been set up, or taken up where it stopped, and can be stepped.

    Processes that train together hold one each and do the same with it; the first of them writes the files.

    Attributes:
        state: what changes while the run goes on.
        lbs: score of linear blend skinning.
        scoring: how long a validation takes, about [s].
        saved: iteration of the state on disk.
    """

    def __init__(self, job: TrainJob, report: Reporter, group: ProcessGroup = SINGLE_PROCESS) -> None:
        self._began = time.monotonic()
        if not (group.size == 1 or job.minutes is None):
            fail(
                str(job.output),
                "minutes for a group of processes",
                "its clocks differ",
                "set the iterations instead (--set iterations=...)",
            )
        self.job, self.report, self.device, self.group = job, report, chosen_device(job.device), group
        self.files, identity = RunFiles(job, self.device, group), {**job.identity(), "processes": group.size}
        self.state, tensors = load_state(self.files.state, identity) if job.resume else (RunState(identity), None)
        self._began -= self.state.seconds
        self.parts = build_parts(job, self.device, group)
        if not job.resume:
            self._fit()
        self.lbs, self.scoring = self._score_lbs()
        if job.minutes and job.learns and not job.resume:
            self._plan(60 * job.minutes)
        self._build_stepper()
        self._announce()
        self.files.tidy()
        if tensors is None:
            self._write_state()
        else:
            self._take_up(tensors)
        self.files.save_curve(self.state, self.lbs)
        self._since = self._saved_at = time.monotonic()

    @property
    def config(self) -> TrainConfig:
        """The schedule as it was asked for, for the minutes that it has, with what had to be lowered."""
        asked, state = self.job.train, self.state
        config = shaped(asked, state.planned) if state.planned else asked
        return state.lowered[-1].applied(config) if state.lowered else config

    def _score_lbs(self) -> tuple[Score, float]:
        """Return the score of linear blend skinning, and how long that took [s]."""
        began = time.monotonic()
        return self.parts.validator.lbs_score(), time.monotonic() - began

    def _plan(self, seconds: float) -> None:
        """Choose as many iterations as fit, by a few steps of a model that is put back afterwards."""
        model, left = self.parts.model, seconds - (time.monotonic() - self._began)
        before = {name: value.clone() for name, value in model.state_dict().items()}
        stepper = self.parts.stepper(self.config, self.job.train.seed)
        self.state.planned = fitting_iterations(stepper, self.config, left, self.scoring, str(self.job.output))
        del stepper
        self._empty_memory()
        model.load_state_dict(before)
        self.report(Message(f"{self.state.planned} iterations are planned for {seconds / 60:g} minutes"))

    def _build_stepper(self) -> None:
        seed = self.job.train.seed + len(self.state.lowered)  # so as not to draw the same windows once more
        self.stepper = self.parts.stepper(self.config, seed)
        self.stepper.faults.count.fill_(self.state.undone)
        self.monitor = DivergenceMonitor(self.stepper.faults)

    def _rebuild_stepper(self, tensors: dict[str, Tensor]) -> None:
        """Make a stepper of what was learned and of what is lowered now."""
        del self.stepper, self.monitor
        self._empty_memory()
        self._build_stepper()
        restore_learned(self.stepper, tensors)

    def _empty_memory(self) -> None:
        gc.collect()
        if self.device.type == "cuda":
            torch.cuda.empty_cache()

    def _take_up(self, tensors: dict[str, Tensor]) -> None:
        restore(self.files.state, self.stepper, tensors, self.group.rank)
        self.saved, best = self.state.iteration, self.state.best
        self.report(Message(f"resumed at iteration {self.state.iteration} of {self.config.iterations}"))
        if best and best.iteration == self.state.iteration:
            self._write_model(best.score)  # the run may have been killed before it was written
        elif best and not self.job.output.is_file():
            self.state.best = None

    def _fit(self) -> None:
        """Lower the batch until the predicted memory fits, and say so."""
        job, config, group, free = self.job, self.job.train, self.group, free_memory(self.device)
        if self.device.type == "cpu":
            free //= group.size
        need_one_window(job.scene, job.model, config, self.parts.reached, free)
        fitting = group.gather(fitting_batch(job.scene, job.model, group.part(config), self.parts.reached, free))
        batch, pretraining_batch = (group.size * min(counts) for counts in zip(*fitting))
        if (batch, pretraining_batch) != (config.batch, config.pretraining_batch):
            found = f"{self._memory() / 2**30:.1f} GiB needed, {free / 2**30:.1f} GiB free on {self.device}"
            self._lower(found, batch, pretraining_batch)

    def _memory(self) -> int:
        """Predict what a step takes in this process [bytes]."""
        own = self.group.part(self.config)
        frames = decoded_frames(own, own.batch)
        return step_memory(self.job.scene, self.job.model, frames, self.parts.reached)

    def _lower(self, found: str, batch: int, pretraining_batch: int) -> None:
        before, lowered = self.config, self.state.lowered
        pace = lowered[-1].pace if lowered else 1.0
        lowered.append(Lowered(self.state.iteration, batch, pretraining_batch, pace))
        self.report(
            Message(
                f"{found}: the batch goes from {before.batch} to {batch} windows and from {before.pretraining_batch} "
                "to "
                f"{pretraining_batch} single poses.",
                "warning",
            )
        )

    def _within_memory(self, work: Callable[[], None]) -> None:
        """Do `work`, with half the batch for as long as the device runs out of memory.

        Raises:
            SsilkError: a batch of one does not fit, or others have to go on with the batch that does not.
        """
        while not suffices(work):
            config, found = self.config, f"iteration {self.state.iteration}: {self.device} is out of memory"
            if self.group.size != 1:
                fail(
                    self.job.scene.garment.mesh.path,
                    found,
                    "a group keeps the batch it has",
                    "train again with a smaller one (--set batch=...)",
                )
            if (
                not (config.pretraining_batch if self.state.iteration < config.static_iterations else config.batch)
                > 1
            ):
                fail(
                    self.job.scene.garment.mesh.path,
                    f"{found} with a batch of one",
                    "a step needs more than is free",
                    "take another device, or shorter windows (--set window=...)",
                )
            self.state.undone = int(self.stepper.faults.count)
            self._lower(found, max(1, config.batch // 2), max(1, config.pretraining_batch // 2))
            self._rebuild_stepper(learned(self.stepper))

    def _announce(self) -> None:
        for motions, most_turn in ((self.job.motions, MOST_TURN), (self.job.held_out, inf)):
            for motion in motions:
                if cuts := len(split_at_cuts(motion, most_turn=most_turn)) - 1:
                    found = "root or a joint jumps" if most_turn < inf else "root jumps"
                    self.report(Message(f"{motion.path}: the {found} {cuts} times; each span is used by itself."))
        path = self.job.scene.garment.mesh.path
        if not self.job.learns:
            self.report(Message(f"{path}: every vertex is pinned to the skeleton; there is nothing to learn."))
        elif self.job.model.scheme == "quasi_static":
            reason = "" if self.job.has_loose else "nothing is loose; "
            self.report(Message(f"{path}: {reason}the garment is quasi-static and gets no stepper."))
        detail = {**self.parts.detail(), "memory predicted [MiB]": self._memory() >> 20}
        self.report(Started("train", self.config.iterations, detail))

    def step(self) -> None:
        """Do one iteration."""
        self._within_memory(lambda: self.stepper.run(self.state.iteration))
        self.state.iteration += 1

    def look(self, seconds_left: float) -> None:
        """Report how far training is, and look after steps that were undone."""
        self._report_progress(seconds_left)
        if told := self.monitor.look():
            self.report(Message(told, "warning"))
        if self.monitor.is_diverging:
            self._recover(f"more than half of the last {SPAN} steps were undone", self.monitor.non_finite_terms)

    def _report_progress(self, seconds_left: float) -> None:
        self.report(Progress(self.state.iteration, self.config.iterations, seconds_left, self._batch_terms()))

    def _batch_terms(self) -> dict[str, float]:
        """Return energies of the last batch [J]; this waits for the device."""
        return {name: float(value) for name, value in self.stepper.terms.items()}

    @property
    def validation_due(self) -> bool:
        """Whether the schedule wants a validation now."""
        config, iteration = self.config, self.state.iteration
        scheduled = iteration % config.validate_every == 0 or iteration == config.iterations
        return scheduled and iteration >= max(1, config.static_iterations) and iteration != self.saved

    def validate(self) -> None:
        """Score the model on the held-out clips and keep it when it is the best so far."""
        state, batch = self.state, self._batch_terms()
        with self._untimed():
            score = self._score()
            if broken := not_finite(score):
                self._recover("validation is not finite", broken)
                return
            self.report(verdict(state.iteration, score, self.lbs, self.job.scene.rig.proxy_count > 0))
            finite = {name: value for name, value in batch.items() if isfinite(value)}
            state.curve = with_point(state.curve, CurvePoint(state.iteration, state.seconds, finite, score))
            better = state.best is None or score.total < state.best.score.total
            if better:
                state.best = Best(state.iteration, score)
            self._write_state()
            self.files.save_curve(state, self.lbs)
            if better:
                self._write_model(score)

    def end_early(self) -> None:
        """End where the time is up, with a validation if what was learned since the last one deserves it."""
        self._report_progress(0.0)
        self.report(Message(f"time is up at iteration {self.state.iteration} of {self.config.iterations}"))
        if self.state.iteration != self.saved and self.state.iteration >= self.config.static_iterations:
            self.validate()

    def _score(self) -> Score:
        found: list[Score] = []
        self._within_memory(lambda: found.append(self.parts.validator.score(self.stepper.averaged)))
        return found[0]

    def _recover(self, found: str, broken: list[str]) -> None:
        """Go back to the state on disk and on from there with smaller steps; that is tried once.

        Raises:
            SsilkError: it was tried before.
        """
        found = self._studied(found, broken)
        config, lowered = self.config, self.state.lowered
        if lowered and lowered[-1].pace < 1:
            self._give_up(found)
        before, tensors = load_state(self.files.state, self.state.asked)
        slower = Lowered(before.iteration, config.batch, config.pretraining_batch, SLOWER)
        undone, seconds = int(self.stepper.faults.count), self.state.seconds
        self.state = replace(before, lowered=[*lowered, slower], undone=undone, seconds=seconds)
        self._rebuild_stepper(tensors)
        text = f"{found}; back to iteration {before.iteration} with steps of {SLOWER:.0%}, see {self.files.fault}"
        self.report(Message(text, "warning"))

    def _studied(self, found: str, broken: list[str]) -> str:
        """Keep the last window that was not finite; return what was found, where."""
        found = f"{found} at iteration {self.state.iteration} ({' and '.join(broken)} not finite)"
        self.files.save_fault(self.stepper, found)
        return found

    def _give_up(self, found: str) -> NoReturn:
        fail(
            str(self.job.output),
            f"training diverged: {found}",
            "the best model before it is kept" if self.state.best else "there is no model yet",
            f"study {self.files.fault}, or train again with smaller steps (--set learning_rate=...)",
        )

    def save(self) -> None:
        """Write the state, unless it is the one on disk."""
        if self.saved != self.state.iteration:
            self._batch_terms()
            with self._untimed():
                self._write_state()

    @property
    def save_due(self) -> bool:
        """Whether enough time has gone by to save again."""
        return self._agreed(time.monotonic() - self._saved_at >= SAVE_EVERY)

    @property
    def time_left(self) -> float:
        """How long the job may go on before a last validation [s]; training before a resumption counts."""
        spent = time.monotonic() - self._began
        return inf if self.job.minutes is None else 60 * self.job.minutes - spent - self.scoring

    def stops(self, stop: threading.Event) -> bool:
        """Return whether to stop here."""
        return self._agreed(stop.is_set())

    def _agreed(self, wish: bool) -> bool:
        """Return whether to do what this process wishes; a group does, now and then, what any of it wishes."""
        if self.group.size == 1:
            return wish
        return self.state.iteration % EVERY == 0 and self.group.any(wish)

    def _write_state(self) -> None:
        self.state.undone = int(self.stepper.faults.count)
        self.files.save_state(self.stepper, self.state)
        self.saved, self._saved_at = self.state.iteration, time.monotonic()

    def _write_model(self, score: Score) -> None:
        self.files.save_model(self.stepper.averaged, self.state, score)
        self.report(Checkpoint(str(self.job.output), self.state.iteration, True))

    @contextmanager
    def _untimed(self) -> Iterator[None]:
        """Leave what is done meanwhile out of the seconds of training."""
        self.state.seconds += time.monotonic() - self._since
        try:
            yield
        finally:
            self._since = time.monotonic()

    def kept(self) -> Score:
        """Return the score of the model on disk; write the present one where the schedule came to no validation yet.

        That one does not count as best: a run that is interrupted here ends, resumed, like one that is not.
        """
        if self.state.best:
            return self.state.best.score
        score = self._score()
        if broken := not_finite(score):
            self._give_up(self._studied("validation is not finite", broken))
        self._write_model(score)
        return score


def train(
    job: TrainJob, report: Reporter, stop: threading.Event | None = None, group: ProcessGroup = SINGLE_PROCESS
) -> TrainingResult:
    """Train a model, keeping the best on disk and the run's state beside it.

    Args:
        job: what to train.
        report: takes the events.
        stop: set from outside to stop after the current step; the state is saved then.
        group: the processes that train together, each of which calls this.

    Raises:
        SsilkError: the inputs or the memory do not suffice, or training diverged.
    """
    run = TrainingRun(job, report, group)
    finished = _loop(run, stop or threading.Event())
    run.save()
    if run.state.undone:
        report(Message(f"{run.state.undone} steps in all were undone.", "warning"))
    score = run.kept()
    return TrainingResult(finished, run.state.iteration, score, run.lbs)


def _loop(run: TrainingRun, stop: threading.Event) -> bool:
    """Do iterations until all are done, or time is up, or somebody wants to stop; return whether it was not that."""
    began, steps, total = time.monotonic(), 0, run.config.iterations
    while run.state.iteration < total and not run.stops(stop):
        if run.time_left <= 0:
            run.end_early()
            return True
        run.step()
        steps += 1
        if run.state.iteration % EVERY == 0 or run.state.iteration == total or steps == 1:
            run.look(min((time.monotonic() - began) / steps * (total - run.state.iteration), max(0.0, run.time_left)))
        if run.validation_due:
            run.validate()
        elif run.save_due:
            run.save()
    return run.state.iteration >= total
