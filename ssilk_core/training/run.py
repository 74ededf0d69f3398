# SPDX-License-Identifier: Apache-2.0
"""A training run: from a scene and motions to a model file (paper, Section 3.7)."""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import inf, isfinite
from typing import NoReturn

import torch
from torch import Tensor

from ..devices import busy_cores, kept_busy, select_device
from ..errors import fail
from ..events import Checkpoint, Message, Progress, Reporter, Started, format_count
from ..physics import loops
from ..scene.kinematics import MAX_JOINT_SPEED, split_at_cuts
from .budget import VALIDATION_SHARE, Pace, check_possible, timed_pace
from .clock import RunClock
from .curve import CurvePoint, append_point
from .divergence import CHECK_INTERVAL, DIVERGENCE_WINDOW, DivergenceMonitor
from .first_steps import compile_loops, try_validation
from .fitting_batch import FittingBatch, need_enough_minutes
from .job import TrainJob
from .memory import fits_in_memory
from .parallel import SINGLE_PROCESS, ProcessGroup
from .parts import build_parts
from .run_files import RunFiles
from .settings import MOST_SMOOTHED_VERTICES, TrainConfig
from .signals import PatientStop
from .state import Best, ReducedSettings, RunState, learned_tensors, load_state, restore, restore_learned
from .validation import Score
from .verdict import non_finite_terms, validation_message

SAVE_INTERVAL = 60.0  # [s] between saved states
REPORT_INTERVAL = 10.0  # [s] between reports of progress there, where steps are long
FIRST_MODEL = 60.0  # [s] of steps after which there is a model, if no validation has written one
RECOVERY_PACE = 0.25  # factor on learning rates after divergence


@dataclass(frozen=True)
class TrainingResult:
    """Result of a run.

    Attributes:
        finished: False if it was interrupted.
        iterations: that are done.
        model_iteration: the one that the model on disk is of.
        score, lbs: of that model, and of linear blend skinning.
        moves: whether dynamic training had begun, where there is any.
        seconds: wall time [s], with that before a resumption. It does not count in a comparison.
    """

    finished: bool
    iterations: int
    model_iteration: int
    score: Score
    lbs: Score
    moves: bool
    seconds: float = field(compare=False)


class TrainingRun:
    """A training run, new or resumed, that advances step by step.

    In data-parallel training each process holds one; the first process writes the files.

    Attributes:
        clock: the run's progress and times, and its plan where it has minutes.
        batch: as large as memory allows.
        lbs: score of linear blend skinning.
        saved: iteration of the state on disk.
    """

    def __init__(self, job: TrainJob, report: Reporter, group: ProcessGroup = SINGLE_PROCESS) -> None:
        began, busy = time.monotonic(), busy_cores()  # before this run keeps any busy itself
        if not (group.size == 1 or job.minutes is None):
            fail(
                str(job.output),
                "minutes for a group of processes",
                "its clocks differ",
                "set the iterations instead (--set iterations=...)",
            )
        self.job, self.report, self.device, self.group = job, report, select_device(job.device), group
        if self.device.type == "cpu" and (others := kept_busy(busy)):
            report(Message(f"{others}: steps take longer meanwhile.", "warning"))
        self.files, identity = RunFiles(job, self.device, group), {**job.identity(), "processes": group.size}
        state, tensors = load_state(self.files.state, identity) if job.resume else (RunState(identity), None)
        self.clock = RunClock(job, state, began)
        if job.minutes and job.is_trainable and not job.resume:
            need_enough_minutes(job, self.config, self.device)
        self.parts = build_parts(job, self.device, group, report)
        self.batch = FittingBatch(self.clock, self.parts, self.device, group, report)
        if not job.resume:
            self.batch.fit()
        if job.minutes and job.is_trainable and loops.available(self.device):
            report(Message("loops are compiled for this processor, or read where they were before"))
            compile_loops(self.parts, self.config)
        self.lbs = self._score_lbs()
        if job.minutes and job.is_trainable:
            if job.resume:
                self.clock.plan_rest(job.minutes)
                left = max(0.0, job.minutes - self.clock.wall / 60)
                report(Message(f"of {job.minutes:g} minutes for the whole run, {left:.1f} are left"))
            else:
                self._plan(job.minutes)
        self._build_stepper()
        self._announce()
        self.files.remove_unfinished()
        if tensors is None:
            self._write_state()
        else:
            self._resume(tensors)
        self.files.save_curve(self.state, self.lbs)
        self._began = self._saved_at = self._reported_at = time.monotonic()
        self._has_model = False
        self.clock.start()

    @property
    def state(self) -> RunState:
        """Progress of the run."""
        return self.clock.state

    @property
    def config(self) -> TrainConfig:
        """The schedule in use."""
        return self.clock.schedule

    def _score_lbs(self) -> Score:
        """Return the score of linear blend skinning, whose validation is the first to be timed."""
        count = format_count(len(self.job.held_out), "motions")
        self.report(Message(f"linear blend skinning is scored on {count} to validate on, to compare with"))
        try_validation(self.parts)
        began = time.monotonic()
        score = self.parts.validator.lbs_score()
        self.clock.scored_lbs(time.monotonic() - began)
        return score

    def _plan(self, minutes: float) -> None:
        """Choose the number of iterations by timing a few steps."""
        config, where = self.config, str(self.job.output)
        self.report(Message("a few steps are timed, to plan as many as fit into the minutes"))
        pace = self._timed(lambda pace: check_possible(pace, config, self.clock.training_time_left(), where))
        self.clock.plan(pace, minutes)
        self.report(Message(f"about {self.state.planned} iterations are planned for {minutes:g} minutes"))

    def _timed(self, check: Callable[[Pace], object] = lambda _: None) -> Pace:
        """Time a few steps, as `timed_pace` does; the model is restored afterwards."""
        model = self.parts.model
        before = {name: value.clone() for name, value in model.state_dict().items()}
        stepper = self.parts.stepper(self.config, self.job.train.seed)
        pace = timed_pace(stepper, self.config, check)
        del stepper
        self._empty_memory()
        model.load_state_dict(before)
        return pace

    def _foresee(self) -> None:
        """Time dynamic steps in the midst of static ones, for the time that is left; nothing is learnt from them.

        On a processor they may take several times what their frames do: they also look for cloth within cloth. On a
        GPU the frames tell enough, and graphs would be captured twice. In a group not all would stop at once.
        """
        with self.clock.paused():
            if loops.available(self.device):
                compile_loops(self.parts, self.config)
            self.clock.foresee(self._timed())

    def _measure_pace(self) -> None:
        """Measure the speed since the last check, and plan again."""
        self.clock.measure()
        self.stepper.config = self.group.local_config(self.config)

    def _build_stepper(self) -> None:
        seed = self.job.train.seed + len(self.state.lowered)  # draws other windows than before
        self.stepper = self.parts.stepper(self.config, seed)
        self.stepper.skipped.count.fill_(self.state.skipped)
        self.monitor = DivergenceMonitor(self.stepper.skipped)

    def _rebuild_stepper(self, tensors: dict[str, Tensor]) -> None:
        """Build a stepper from saved tensors and the reduced settings."""
        del self.stepper, self.monitor
        self._empty_memory()
        self._build_stepper()
        restore_learned(self.stepper, tensors)

    def _empty_memory(self) -> None:
        gc.collect()
        if self.device.type == "cuda":
            torch.cuda.empty_cache()

    def _resume(self, tensors: dict[str, Tensor]) -> None:
        restore(self.files.state, self.stepper, tensors, self.group.rank)
        self.saved, best = self.state.iteration, self.state.best
        self.report(Message(f"resumed at iteration {self.state.iteration} of {self.config.iterations}"))
        if best and best.iteration == self.state.iteration:
            self._write_model(best.score)  # the run may have been killed before it was written
        elif best and not self.job.output.is_file():
            self.state.best = None

    def _within_memory(self, work: Callable[[], None]) -> None:
        """Run `work`, and halve the batch while the device runs out of memory, as `FittingBatch.halve` does."""
        while not fits_in_memory(work):
            self.state.skipped = int(self.stepper.skipped.count)
            self.batch.halve()
            self._rebuild_stepper(learned_tensors(self.stepper))

    def _announce(self) -> None:
        skeleton = self.job.scene.character.skeleton
        for motions, max_joint_speed in ((self.job.motions, MAX_JOINT_SPEED), (self.job.held_out, inf)):
            for motion in motions:
                if cuts := len(split_at_cuts(motion, skeleton, max_joint_speed=max_joint_speed)) - 1:
                    found = "root or a joint jumps" if max_joint_speed < inf else "root jumps"
                    text = f"{motion.path}: the {found} {cuts} times; the spans between are used separately."
                    self.report(Message(text))
        path = self.job.scene.garment.mesh.path
        if not self.job.is_trainable:
            self.report(Message(f"{path}: every vertex is pinned to the skeleton; there is nothing to learn."))
        elif self.job.model.scheme == "quasi_static":
            reason = "" if self.job.has_loose else "no vertex is loose; "
            self.report(Message(f"{path}: {reason}the garment is quasi-static and gets no stepper."))
        rough = self.parts.smoothing is None and self.parts.model.decoder.shapes.numel() > 0
        if self.config.shape_smoothing and rough and not self.job.base:
            text = f"{path}: steps of blendshapes of more than {MOST_SMOOTHED_VERTICES:,} vertices are not smoothed."
            self.report(Message(text))
        detail = {**self.parts.detail(), "memory predicted [MiB]": self.batch.memory >> 20}
        self.report(Started("train", self.config.iterations, detail))

    def step(self) -> None:
        """Do one iteration."""
        self._within_memory(lambda: self.stepper.run(self.state.iteration))
        self.state.iteration += 1
        self.clock.stepped()
        # On a processor steps are long, and those launched are done.
        if self.device.type == "cpu" and self.clock.measurement_due:
            self._measure_pace()
        if self.device.type == "cpu" and self.group.size == 1 and self.clock.lacks_dynamic:
            self._foresee()

    def check(self) -> None:
        """Report progress and skipped steps, follow the clock, and recover if training diverges."""
        self.report_progress()
        self._measure_pace()
        if text := self.monitor.check():
            self.report(Message(text, "warning"))
        if self.monitor.is_diverging:
            self._recover(
                f"more than half of the last {DIVERGENCE_WINDOW} steps were skipped", self.monitor.non_finite_terms
            )

    @property
    def report_due(self) -> bool:
        """Whether nothing was said of the progress for long; a GPU would have to be waited for."""
        return self.device.type == "cpu" and time.monotonic() - self._reported_at >= REPORT_INTERVAL

    def report_progress(self) -> None:
        """Report the progress and the energies of the last batch, for which a GPU is waited for."""
        self._reported_at, terms = time.monotonic(), self._batch_terms()
        left = self.clock.seconds_left()
        self.report(Progress(self.state.iteration, self.config.iterations, left, terms))

    def _batch_terms(self) -> dict[str, float]:
        """Return energies of the last batch [J]; this waits for the device."""
        return {name: float(value) for name, value in self.stepper.terms.items()}

    @property
    def validation_due(self) -> bool:
        """Whether the schedule asks for a validation now: of static training too, for a first model to look at."""
        config, iteration = self.config, self.state.iteration
        scheduled = iteration % config.validate_every == 0
        if self.state.validations:  # the plan changes, and with it the interval
            last = self.state.curve[-1].iteration if self.state.curve else 0
            scheduled = iteration - last >= config.validate_every
        scheduled |= iteration == config.iterations
        return scheduled and iteration > 0 and iteration != self.saved

    def validate(self) -> None:
        """Score the model on the held-out clips and save it if it is the best so far."""
        state, batch = self.state, self._batch_terms()
        with self.clock.paused():
            score = self._score()
            if broken := non_finite_terms(score):
                self._recover("validation is not finite", broken)
                return
            dynamic = self.job.scene.rig.proxy_count > 0 and state.iteration > self.config.static_iterations
            self.report(validation_message(state.iteration, score, self.lbs, dynamic))
            finite = {name: value for name, value in batch.items() if isfinite(value)}
            state.curve = append_point(state.curve, CurvePoint(state.iteration, state.seconds, finite, score))
            better = state.best is None or score.judged < state.best.score.judged
            if better:
                state.best = Best(state.iteration, score)
            self._write_state()
            self.files.save_curve(state, self.lbs)
            if better:
                self._write_model(score)

    def end_early(self) -> None:
        """End because the time is up, with a validation if there were steps since the last one."""
        self.report_progress()
        self.report(Message(f"time is up at iteration {self.state.iteration} of {self.config.iterations}"))
        if self.state.iteration != self.saved:
            self.validate()

    def _score(self) -> Score:
        found: list[Score] = []
        began = time.monotonic()
        self._within_memory(lambda: found.append(self.parts.validator.score(self.stepper.ema_model)))
        self.clock.validated(time.monotonic() - began)
        return found[0]

    def _recover(self, found: str, broken: list[str]) -> None:
        """Return to the state on disk and continue with smaller learning rates, once.

        Raises:
            SsilkError: the run has recovered once before.
        """
        found = self._record_fault(found, broken)
        config, lowered = self.config, self.state.lowered
        if lowered and lowered[-1].pace < 1:
            self._give_up(found)
        before, tensors = load_state(self.files.state, self.state.asked)
        slower = ReducedSettings(before.iteration, config.batch, config.pretraining_batch, RECOVERY_PACE)
        skipped, seconds = int(self.stepper.skipped.count), self.state.seconds
        self.clock.state = replace(before, lowered=[*lowered, slower], skipped=skipped, seconds=seconds)
        self._rebuild_stepper(tensors)
        text = (
            f"{found}; back to iteration {before.iteration} with {RECOVERY_PACE:.0%} of the learning rate, see "
            f"{self.files.fault}"
        )
        self.report(Message(text, "warning"))

    def _record_fault(self, found: str, broken: list[str]) -> str:
        """Save the last skipped step; return a description of what was found."""
        found = f"{found} at iteration {self.state.iteration} ({' and '.join(broken)} not finite)"
        self.files.save_fault(self.stepper, found)
        return found

    def _give_up(self, found: str) -> NoReturn:
        fail(
            str(self.job.output),
            f"training diverged: {found}",
            "the best model before it is kept" if self.state.best else "there is no model yet",
            f"study {self.files.fault}, or train again with a smaller learning rate (--set learning_rate=...)",
        )

    def save(self) -> None:
        """Write the state, unless it is already on disk."""
        if self.saved != self.state.iteration:
            self._batch_terms()
            with self.clock.paused():
                self._write_state()

    @property
    def save_due(self) -> bool:
        """Whether it is time to save the state again."""
        return self._any_process(time.monotonic() - self._saved_at >= SAVE_INTERVAL)

    @property
    def first_model_due(self) -> bool:
        """Whether a model should be written although no validation is due: there is none, and steps take long.

        A validation that takes long waits until it is a small part of the time.
        """
        due = max(FIRST_MODEL, self.clock.validation_seconds / VALIDATION_SHARE)
        wish = not (self._has_model or self.state.best) and time.monotonic() - self._began >= due
        return self._any_process(wish)

    def write_first_model(self) -> None:
        """Write the model as it is. It does not count as the best one, so that no clock decides which one is kept."""
        with self.clock.paused():
            score = self._score()
            self._has_model = True
            if not non_finite_terms(score):
                self._write_model(score)

    def should_stop(self, stop: threading.Event) -> bool:
        """Return whether to stop after this iteration."""
        return self._any_process(stop.is_set())

    def _any_process(self, wish: bool) -> bool:
        """Return `wish`; in a group, every `CHECK_INTERVAL` iterations, whether any process wishes it."""
        if self.group.size == 1:
            return wish
        return self.state.iteration % CHECK_INTERVAL == 0 and self.group.any(wish)

    def _write_state(self) -> None:
        self.state.skipped, self.state.wall = int(self.stepper.skipped.count), self.clock.wall
        self.files.save_state(self.stepper, self.state)
        self.saved, self._saved_at = self.state.iteration, time.monotonic()

    def _write_model(self, score: Score) -> None:
        self.files.save_model(self.stepper.ema_model, self.state, score, self.lbs)
        self.report(Checkpoint(str(self.job.output), self.state.iteration, True))

    def final_score(self) -> Score:
        """Return the score of the model on disk; before the first validation, write the current model.

        That model does not count as the best one, so that an interrupted and resumed run ends like any other.
        """
        if self.state.best:
            return self.state.best.score
        score = self._score()
        if broken := non_finite_terms(score):
            self._give_up(self._record_fault("validation is not finite", broken))
        self._write_model(score)
        return score


def train(
    job: TrainJob, report: Reporter, stop: threading.Event | None = None, group: ProcessGroup = SINGLE_PROCESS
) -> TrainingResult:
    """Train a model; the best one and the run's state are kept on disk.

    Args:
        job: what to train.
        report: receives the events.
        stop: set from outside to save the state and stop after the current step, or inside one that takes longer than
            a `PatientStop` waits.
        group: the processes that train together, each of which calls this.

    Raises:
        SsilkError: inputs or memory do not suffice, or training diverged.
    """
    run = TrainingRun(job, report, group)
    stop = stop or threading.Event()
    try:
        finished = _loop(run, stop)
    except KeyboardInterrupt:
        report(Message(f"stopped at once; --resume continues from iteration {run.saved}."))
        raise
    if isinstance(stop, PatientStop):
        stop.obeyed()
    run.save()
    if run.state.skipped:
        report(Message(f"{run.state.skipped} steps in total were skipped.", "warning"))
    score = run.final_score()
    state, best = run.state, run.state.best
    of = best.iteration if best else state.iteration
    return TrainingResult(finished, state.iteration, of, score, run.lbs, run.clock.has_moved, run.clock.wall)


def _loop(run: TrainingRun, stop: threading.Event) -> bool:
    """Iterate until all iterations are done, the time is up or `stop` is set; return False in the last case."""
    steps = 0
    while run.state.iteration < (total := run.config.iterations) and not run.should_stop(stop):
        if run.clock.time_left <= 0:
            run.end_early()
            return True
        run.step()
        if stop.is_set() and isinstance(stop, PatientStop):
            stop.obeyed()  # before a validation, which takes longer
        steps += 1
        if run.state.iteration % CHECK_INTERVAL == 0 or run.state.iteration == total or steps == 1:
            run.check()
        elif run.report_due:
            run.report_progress()
        if run.validation_due:
            run.validate()
        elif run.first_model_due:
            run.write_first_model()
        elif run.save_due:
            run.save()
    return run.state.iteration >= run.config.iterations
