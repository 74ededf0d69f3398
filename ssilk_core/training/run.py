# SPDX-License-Identifier: Apache-2.0
"""A training run: from a scene and motions to a model file (paper, Section 3.7)."""

from __future__ import annotations

import platform
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from .. import __version__
from ..assets import Motion, Scene
from ..checkpoint import model_file, save_model
from ..config import ModelConfig, TrainConfig
from ..devices import chosen_device, device_name
from ..energy import GarmentEnergy
from ..errors import need
from ..events import Checkpoint, Message, Progress, Reporter, Started
from ..fabrics import Fabric
from ..kinematics import split_at_cuts
from ..model.body import CollisionBody
from ..model.network import GarmentModel, model_joints
from .bank import build_bank
from .memory import decoded_frames, fitting_batch, free_memory, step_memory
from .objective import Objective
from .reach import reachable_body
from .state import RunState, batches_before, canonical, load_state, save_state, scene_digest, state_path
from .step import Stepper
from .validation import Score, Validator
from .windows import WindowSampler

# A rollout closer than this to the quasi-static state of each pose has learned no dynamics worth the name.
NO_DYNAMICS = 2e-3  # [m]


@dataclass(frozen=True, kw_only=True)
class TrainJob:
    """Everything a training needs.

    Attributes:
        scene: character with its body, garment, rig.
        motions, held_out: what is trained on, and what is validated on.
        output: the model file to write; the run's state lies beside it.
        inputs: hashes of the input files by name, for the provenance.
    """

    scene: Scene
    motions: Sequence[Motion]
    held_out: Sequence[Motion]
    model: ModelConfig
    train: TrainConfig
    fabric: Fabric
    output: Path
    device: str = "auto"
    resume: bool = False
    inputs: dict[str, str] | None = None


@dataclass(frozen=True)
class Trained:
    """How a run ended: `finished` is False when it was interrupted; `score` is that of the best model kept."""

    finished: bool
    iterations: int
    score: Score
    plain: Score


def split_motions(motions: Sequence[Motion]) -> tuple[list[Motion], list[Motion]]:
    """Return 80 % of the clips to train on and 20 % to validate on, spread evenly; one clip is cut in two."""
    if len(motions) == 1:
        cut = int(motions[0].frame_count * 0.8)
        need(cut > 0, motions[0].path, "one motion of one frame", "longer motions are needed to train")
        return [motions[0].clip(0, cut)], [motions[0].clip(cut, motions[0].frame_count)]
    held = set(range(4, len(motions), 5)) or {len(motions) - 1}
    return [m for i, m in enumerate(motions) if i not in held], [m for i, m in enumerate(motions) if i in held]


class Run:
    """A training run that has been set up and can be stepped."""

    def __init__(self, job: TrainJob, report: Reporter) -> None:
        self.report, self.device = report, chosen_device(job.device)
        reach = reachable_body(job.scene, [*job.motions, *job.held_out])
        self.job = job = self._fitted(job, len(reach.vertices))
        joints = model_joints(job.scene, reach.joints)
        scene, skeleton = job.scene, job.scene.character.skeleton
        self.model = GarmentModel(scene, job.model, joints, job.train.seed).to(self.device)
        bank = build_bank(job.motions, skeleton, joints, job.model.fps, self.device)
        held = build_bank(job.held_out, skeleton, joints, job.model.fps, self.device)
        energy = GarmentEnergy(scene.garment.mesh, job.fabric, device=self.device)
        body = CollisionBody(
            scene.character.merged_body(), skeleton.joint_count, vertices=reach.vertices, device=self.device
        )
        generator = torch.Generator(self.device).manual_seed(job.train.seed)
        sampler = WindowSampler(bank, job.train, job.model.latent, generator)
        self.stepper = Stepper(
            self.model,
            Objective(self.model, energy, body, bank, job.train.surface == "triangles"),
            sampler,
            job.train,
        )
        # Validation looks at the whole body: what training leaves out must not go unnoticed.
        whole = CollisionBody(scene.character.merged_body(), skeleton.joint_count, device=self.device)
        self.validator = Validator(
            held, energy, whole, scene.plain_skin, self.model.decoder.rest, job.model.fps, job.train.valid_frames
        )
        self.digest = scene_digest(job.scene)
        self.iteration = 0
        self.best: Score | None = None
        self._announce(len(reach.vertices), len(joints))

    def _fitted(self, job: TrainJob, body_vertices: int) -> TrainJob:
        """Lower the batch until the predicted memory fits, and say so; a resumed run keeps the batch it had."""
        free = free_memory(self.device)
        if job.resume:
            batch, warm = batches_before(state_path(job.output), job.train)
        else:
            batch, warm = fitting_batch(job.scene, job.model, job.train, body_vertices, free)
        needed = step_memory(job.scene, job.model, decoded_frames(job.train, job.train.batch), body_vertices)
        if (batch, warm) == (job.train.batch, job.train.warm_batch):
            return job
        self.report(
            Message(
                f"{needed / 2**30:.1f} GiB needed, {free / 2**30:.1f} GiB free on {self.device}: the batch goes "
                f"from {job.train.batch} to {batch} windows and from {job.train.warm_batch} to {warm} single poses.",
                "warning",
            )
        )
        return replace(job, train=replace(job.train, batch=batch, warm_batch=warm))

    def _announce(self, body_vertices: int, joints: int) -> None:
        job, mesh = self.job, self.job.scene.garment.mesh
        for motion in (*job.motions, *job.held_out):
            if len(spans := split_at_cuts(motion)) > 1:
                self.report(
                    Message(f"{motion.path}: the root jumps {len(spans) - 1} times; each span is used by itself.")
                )
        frames = decoded_frames(job.train, job.train.batch)
        self.report(
            Started(
                "train",
                job.train.iterations,
                {
                    "garment": mesh.path,
                    "vertices": mesh.vertex_count,
                    "proxies": job.scene.rig.proxy_count,
                    "blendshapes": job.model.shapes,
                    "joints in view": joints,
                    "body vertices": body_vertices,
                    "parameters": sum(p.numel() for p in self.model.parameters()),
                    "device": str(self.device),
                    "memory predicted [MiB]": step_memory(job.scene, job.model, frames, body_vertices) >> 20,
                },
            )
        )

    def asked(self) -> dict[str, Any]:
        """Return what makes this run the run it is; a resumed run must be asked the same."""
        job = self.job
        return canonical(
            {
                "model": asdict(job.model),
                "train": asdict(job.train),
                "fabric": asdict(job.fabric),
                "inputs": job.inputs or {},
                "garment": job.scene.garment.mesh.path,
                "scene": self.digest,
            }
        )

    def save_state(self) -> None:
        """Write the run's state beside the model."""
        save_state(state_path(self.job.output), self.stepper, RunState(self.iteration, self.best, self.asked()))

    def resume(self) -> None:
        """Take up the state that lies beside the model."""
        state = load_state(state_path(self.job.output), self.stepper, self.asked())
        self.iteration, self.best = state.iteration, state.best

    def validate(self) -> Score:
        """Score the model on the held-out clips and keep it when it is the best so far."""
        score = self.validator.score(self.stepper.averaged)
        need(
            np.isfinite(score.total),
            str(self.job.output),
            f"training diverged by iteration {self.iteration}",
            "the best model before it is kept",
            "train again with smaller steps (--set rate=...)",
        )
        if self.best is None or score.total < self.best.total:
            self.best = score
            provenance = self.provenance(score)
            save_model(self.job.output, model_file(self.stepper.averaged, self.job.fabric, provenance))
            self.report(Checkpoint(str(self.job.output), self.iteration, True))
        return score

    def kept(self) -> Score:
        """Return the score of the model on disk; write the present one where the schedule came to no validation yet.

        That one does not count as best: a run that is interrupted here ends, resumed, like one that is not.
        """
        if self.best is not None:
            return self.best
        score = self.validate()
        self.best = None
        return score

    def provenance(self, score: Score) -> dict[str, Any]:
        """Return how the model came to be."""
        return canonical(
            {
                **self.asked(),
                "iteration": self.iteration,
                "seed": self.job.train.seed,
                "ssilk": __version__,
                "torch": torch.__version__,
                "python": platform.python_version(),
                "device": device_name(self.device),
                "motions": [motion.path for motion in self.job.motions],
                "validation": {**score.terms, "total": score.total, "collisions": score.collisions},
            }
        )


@contextmanager
def interruptible() -> Iterator[threading.Event]:
    """Yield an event that SIGINT and SIGTERM set, so that work stops between two steps; a second one is immediate."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def ask(number: int, frame: object) -> None:
        stop.set()
        signal.signal(number, before[signal.Signals(number)])

    for number in before:
        signal.signal(number, ask)
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def train(job: TrainJob, report: Reporter, stop: threading.Event | None = None) -> Trained:
    """Train a model, keeping the best on disk and the run's state beside it.

    Args:
        job: what to train.
        report: takes the events.
        stop: set from outside to stop after the current step; the state is saved then.

    Raises:
        SsilkError: the inputs do not suffice, or training diverged.
    """
    run = Run(job, report)
    if job.resume:
        run.resume()
        report(Message(f"resumed at iteration {run.iteration} of {job.train.iterations}"))
    plain = run.validator.plain_score()
    _loop(run, report, stop or threading.Event(), plain)
    run.save_state()
    score = run.kept()
    finished = run.iteration >= run.job.train.iterations
    return Trained(finished, run.iteration, score, plain)


def _loop(run: Run, report: Reporter, stop: threading.Event, plain: Score) -> None:
    config, began, first = run.job.train, time.monotonic(), run.iteration
    while run.iteration < config.iterations and not stop.is_set():
        run.stepper.run(run.iteration)
        run.iteration += 1
        elapsed = time.monotonic() - began
        left = elapsed / (run.iteration - first) * (config.iterations - run.iteration)
        if run.iteration % 20 == 0 or run.iteration in (first + 1, config.iterations):
            terms = {name: float(value) for name, value in run.stepper.terms.items()}
            report(Progress(run.iteration, config.iterations, left, terms))
        rolling = run.iteration >= max(1, config.warm_iterations)
        if rolling and (run.iteration % config.validate_every == 0 or run.iteration == config.iterations):
            report(_judgement(run, run.validate(), plain))
            run.save_state()
    skipped = int(run.stepper.skipped)
    if skipped:
        report(Message(f"{skipped} steps were left out because a gradient was not finite.", "warning"))


def _judgement(run: Run, score: Score, plain: Score) -> Message:
    share = 1 - score.total / plain.total
    terms = ", ".join(f"{name} {value:.4g}" for name, value in score.terms.items())
    text = (
        f"validation at {run.iteration}: total {score.total:.4g} J, "
        f"{share:.1%} under plain skinning's {plain.total:.4g} J "
        f"({terms}), collisions {score.collisions:.2%}, motion of its own {score.dynamics * 1000:.0f} mm"
    )
    if score.dynamics < NO_DYNAMICS and run.job.scene.rig.proxy_count:
        return Message(f"{text}; nothing dynamic is being learned: check that the motions move", "warning")
    return Message(text)
