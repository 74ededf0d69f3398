# SPDX-License-Identifier: Apache-2.0
"""Whole training runs on the toy scene: learning, stopping, resuming, running out of memory, diverging."""

import json
import math
import signal
import threading
from collections.abc import Callable
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from ssilk_core.cli import main
from ssilk_core.cli import train as command
from ssilk_core.devices import select_device
from ssilk_core.errors import EXIT_WORSE, SsilkError
from ssilk_core.events import Checkpoint, Event, Message, Progress, Started, silent
from ssilk_core.network.checkpoint import load_model
from ssilk_core.network.model.network import GarmentModel
from ssilk_core.network.settings import ModelConfig
from ssilk_core.physics.collision import CollisionBody
from ssilk_core.physics.energy import TERMS, GarmentEnergy
from ssilk_core.physics.intersections.contours import IntersectionContours
from ssilk_core.physics.skin.covered_skin import CoveredSkin
from ssilk_core.physics.skin.figures import ShownSkin
from ssilk_core.scene.fabrics import Fabric
from ssilk_core.training import divergence, fitting_batch, validation
from ssilk_core.training import job as job_module
from ssilk_core.training import run as training
from ssilk_core.training.curve import CurvePoint, append_point, curve_path
from ssilk_core.training.divergence import fault_path
from ssilk_core.training.job import TrainJob, split_motions
from ssilk_core.training.motion_bank import build_bank
from ssilk_core.training.objective import Objective
from ssilk_core.training.parts import build_parts
from ssilk_core.training.run import train
from ssilk_core.training.run_files import RunFiles
from ssilk_core.training.settings import TrainConfig
from ssilk_core.training.signals import stop_on_signals
from ssilk_core.training.state import (
    RunState,
    _need_same,
    json_round_trip,
    learned_tensors,
    load_state,
    state_path,
)
from ssilk_core.training.step import EAGER_STEPS, Stepper, learning_rate
from ssilk_core.training.validation import Score, Validator
from ssilk_core.training.verdict import is_worse, percent, share_below, shortcomings, worse_message
from ssilk_core.training.windows import WindowSampler

pytestmark = pytest.mark.usefixtures("few_contacts")

SHORT = TrainConfig(
    iterations=14,
    static_fraction=0.3,
    perturbations=0,
    optimiser="muon",  # beside Adam
    pretraining_batch=6,
    batch=3,
    static_batch=4,
    window=5,
    learning_rate_warmup=2,
    ema_decay=0.9,
    validate_every=5,
    valid_frames=12,
    seed=7,
)
Make = Callable[..., TrainJob]


@pytest.fixture(scope="module")
def job(scene, toy_motion, tmp_path_factory) -> Make:
    folder = tmp_path_factory.mktemp("models")
    motions = [toy_motion(scene, 60, path="/a"), toy_motion(scene, 45, speed=1.7, path="/b")]
    held = [toy_motion(scene, 40, speed=1.3, path="/held")]

    def make(name: str, config: TrainConfig = SHORT, **changes: object) -> TrainJob:
        whole = TrainJob(
            scene=scene,
            motions=motions,
            held_out=held,
            model=ModelConfig(latent=6, widths=(16,), shapes=3),
            train=config,
            fabric=Fabric("toy", bending=1e-4),
            output=folder / f"{name}.safetensors",
            device="cpu",
            inputs={"stage.usd": "abc"},
        )
        return replace(whole, **changes)

    return make


@pytest.fixture(scope="module")
def uninterrupted(job) -> TrainJob:
    done = job("uninterrupted")
    train(done, silent)
    return done


def stop_after(monkeypatch: pytest.MonkeyPatch, iterations: int) -> threading.Event:
    """Return an event that is set once so many steps have been done."""
    stop, step, count = threading.Event(), Stepper.run, [0]

    def counted(self: Stepper, iteration: int) -> None:
        step(self, iteration)
        count[0] += 1
        if count[0] == iterations:
            stop.set()

    monkeypatch.setattr(Stepper, "run", counted)
    return stop


def assert_same_state(one: TrainJob, other: TrainJob) -> None:
    """States are equal to the last bit; only the time that was taken differs."""
    (a, tensors), (b, others) = (load_state(state_path(job.output), job.identity()) for job in (one, other))
    untimed = [
        replace(state, seconds=0, curve=[replace(point, seconds=0) for point in state.curve]) for state in (a, b)
    ]
    assert untimed[0] == untimed[1] and tensors.keys() == others.keys()
    assert all(torch.equal(value, others[name]) for name, value in tensors.items())


def test_extra_motions_are_as_many_as_fit(job, monkeypatch):
    whole = job("extra", replace(SHORT, recombinations=6, perturbations=3))
    own, longer = len(whole.training_motions()), sum(motion.frame_count for motion in whole.motions)
    assert whole.extra_motions() == (6, 3) and own == 2 * (1 + 3)  # the toy has no limbs
    monkeypatch.setattr(job_module, "MOST_POSES", longer * whole.model.fps / whole.motions[0].fps * 5.5)
    assert whole.extra_motions() == (2, 2)  # four of nine, a third of them perturbed, or a little more
    found = whole.training_motions()
    assert len(found) == 2 * (1 + 2) and found[:2] == [*whole.motions]
    told = []
    build_parts(whole, torch.device("cpu"), report=told.append)
    assert any("2 recombined and 2 perturbed" in event.text for event in told)
    few = job("few", replace(SHORT, recombinations=3, perturbations=1))
    for copies, expected in ((4.99, (2, 1)), (2.0, (0, 1)), (1.99, (0, 0))):
        monkeypatch.setattr(job_module, "MOST_POSES", longer * whole.model.fps / whole.motions[0].fps * copies)
        assert few.extra_motions() == expected
    assert few.training_motions() == [*few.motions]


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_a_share_of_the_perturbed_motions_turns_over(job, share):
    whole = job("tumbling", replace(SHORT, perturbations=4, tumbling=share))
    own = [motion.rotations[:, 0] for motion in whole.motions] * 5
    same = [np.allclose(motion.rotations[:, 0], root) for motion, root in zip(whole.training_motions(), own)]
    assert all(same[:2]) and all(same[2:]) == (not share) and any(same[2:]) == (not share)


def test_training_lowers_the_energy_of_held_out_motion(job):
    config = replace(
        SHORT,
        iterations=60,
        static_fraction=0.6,
        pretraining_batch=12,
        validate_every=60,
        static_learning_rate=6e-3,
        learning_rate=2e-3,
        closest_point="vertices",
    )
    trained = train(job("learning", config), silent)
    assert trained.finished and trained.iterations == 60
    assert trained.score.total < 0.8 * trained.lbs.total
    assert trained.lbs.dynamics == 0 < trained.score.dynamics
    assert trained.lbs.terms["gravity"] == pytest.approx(0, abs=1e-6)


def test_a_run_repeats_bit_for_bit(job, uninterrupted):
    again = job("again")
    train(again, silent)
    assert again.output.read_bytes() == uninterrupted.output.read_bytes()
    assert_same_state(again, uninterrupted)


def test_a_resumed_run_equals_an_uninterrupted_one_bit_for_bit(job, uninterrupted, monkeypatch):
    """Stopped while it learns single poses, at a validation and before the last step."""
    resumed = job("resumed")
    for steps, done in ((2, 2), (3, 5), (8, 13)):
        with monkeypatch.context() as patch:
            trained = train(replace(resumed, resume=done > steps), silent, stop_after(patch, steps))
        assert not trained.finished and trained.iterations == done
        load_model(resumed.output)
    trained = train(replace(resumed, resume=True), silent)
    assert trained.finished
    assert resumed.output.read_bytes() == uninterrupted.output.read_bytes()
    assert_same_state(resumed, uninterrupted)


def test_a_finished_run_resumed_changes_nothing(job, uninterrupted):
    before = uninterrupted.output.read_bytes()
    trained = train(replace(uninterrupted, resume=True), silent)
    assert trained.finished and trained.iterations == 14
    assert uninterrupted.output.read_bytes() == before


@pytest.mark.parametrize(
    "change, name",
    [
        ({"train": replace(SHORT, seed=8)}, "seed"),
        ({"train": replace(SHORT, iterations=20)}, "iterations"),
        ({"model": ModelConfig(latent=7, widths=(16,), shapes=3)}, "latent"),
        ({"fabric": Fabric("toy", bending=2e-4)}, "bending"),
        ({"inputs": {"stage.usd": "changed"}}, "stage.usd"),
    ],
)
def test_a_run_is_not_resumed_with_other_options(uninterrupted, change, name):
    with pytest.raises(SsilkError, match=rf"{name}.*a resumed run repeats the same command"):
        train(replace(uninterrupted, resume=True, **change), silent)


@pytest.mark.parametrize("changed", ["motions", "held_out"])
@pytest.mark.parametrize(
    ("change", "name"),
    [
        (lambda motion: replace(motion, path="/a.usd:/Other"), "/a.usd:/Other"),
        (lambda motion: motion.clip(0, 30), "/(a|held)"),
        (lambda motion: replace(motion, start=7), "/(a|held)"),
    ],
)
def test_a_run_is_not_resumed_on_another_animation_of_the_same_files(uninterrupted, changed, change, name):
    first, *others = getattr(uninterrupted, changed)
    with pytest.raises(SsilkError, match=rf"started with another .*{name}.*a resumed run repeats the same command"):
        train(replace(uninterrupted, resume=True, **{changed: [change(first), *others]}), silent)


def test_a_run_is_resumed_however_its_paths_are_written(job, uninterrupted):
    first, *others = uninterrupted.motions
    inputs = {"shots/a.usd": "123", "stage.usd": "abc", "copy/stage.usd": "abc"}
    written = replace(uninterrupted, motions=[replace(first, path="shots/a.usd:/Walk"), *others], inputs=inputs)
    before = json_round_trip(written.identity())
    elsewhere = {"/proj/link/a.usd": "123", "/proj/./stage.usd": "abc", "/proj/copy/stage.usd": "abc"}
    again = replace(written, motions=[replace(first, path="/proj/link/./a.usd:/Walk"), *others], inputs=elsewhere)
    _need_same(Path("state"), again.identity(), before)
    for wrong in (
        replace(again, inputs=elsewhere | {"/proj/link/a.usd": "124"}),
        replace(again, motions=[replace(first, path="/proj/link/a.usd:/Run"), *others]),
    ):
        with pytest.raises(SsilkError, match=r"a\.usd"):
            _need_same(Path("state"), wrong.identity(), before)


def test_damaged_or_missing_states_are_refused(job, uninterrupted):
    missing = job("missing", resume=True)
    with pytest.raises(SsilkError, match="there is no training to resume"):
        train(missing, silent)
    whole = state_path(uninterrupted.output).read_bytes()
    for size in (0, 5, 100, len(whole) // 2, len(whole) - 1):
        state_path(missing.output).write_bytes(whole[:size])
        with pytest.raises(SsilkError, match=r"the training state is damaged .*delete it"):
            train(missing, silent)


def test_a_byte_that_changed_anywhere_in_a_state_is_found(job, uninterrupted):
    damaged, whole = job("flipped", resume=True), state_path(uninterrupted.output).read_bytes()
    for place in np.linspace(8, len(whole) - 1, 60).astype(int):
        changed = bytes([whole[place] ^ 1])
        state_path(damaged.output).write_bytes(whole[:place] + changed + whole[place + 1 :])
        with pytest.raises(SsilkError, match=r"the training state is damaged .*delete it"):
            load_state(state_path(damaged.output), damaged.identity() | {"processes": 1})


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"iteration": 10**9}, "iteration is 1000000000, beyond 0 to 14"),
        ({"iteration": -5}, "iteration is -5"),
        ({"iteration": 2.5}, "iteration is 2.5"),
        ({"planned": -1}, "planned is -1"),
        ({"skipped": 10**30}, "skipped is 1000"),
        ({"seconds": math.nan}, "a duration"),
        ({"best": None, "lowered": [{"iteration": 3, "batch": 10**6, "pretraining_batch": 1}]}, "batch is 1000000"),
        ({"lowered": 3}, "not iterable"),
        (None, "holds NaN"),
    ],
)
def test_a_state_without_checksum_that_no_run_can_have_reached_is_refused(job, uninterrupted, change, says):
    resumed = job("impossible", resume=True)
    with safe_open(state_path(uninterrupted.output), "pt") as stream:
        tensors = {name: stream.get_tensor(name) for name in stream.keys()}  # noqa: SIM118
        document = json.loads(stream.metadata()["ssilk_state"])
    if change is None:
        name = next(name for name in tensors if name.startswith("adam.") and tensors[name].ndim)
        tensors[name].view(torch.uint8).fill_(255)
    save_file(tensors, state_path(resumed.output), {"ssilk_state": json.dumps(document | (change or {}))})
    before = state_path(resumed.output).read_bytes()
    with pytest.raises(SsilkError, match=f"the training state is damaged .*{says}") as error:
        train(resumed, silent)
    assert "\n" not in str(error.value) and error.value.exit_code == 2
    assert state_path(resumed.output).read_bytes() == before and not resumed.output.exists()


def test_the_best_model_is_kept(job, monkeypatch):
    """Validation totals are replaced by ones that fall, then rise."""
    totals, score = iter([3.0, 1.0, 2.0, 5.0]), validation.Validator.score
    monkeypatch.setattr(
        validation.Validator, "score", lambda self, model: replace(score(self, model), terms={"all": next(totals)})
    )
    events: list[Event] = []
    kept = job("best", replace(SHORT, validate_every=4, iterations=16, static_fraction=0.0))
    trained = train(kept, events.append)
    assert [event.done for event in events if isinstance(event, Checkpoint)] == [4, 8]
    assert trained.score.total == 1.0
    assert load_model(kept.output).provenance["iteration"] == 8


@pytest.mark.parametrize("factor", [1.0, 3.8])
def test_a_model_says_whether_it_is_worse_than_none(job, monkeypatch, factor):
    lbs_score = validation.Validator.lbs_score
    monkeypatch.setattr(
        validation.Validator,
        "score",
        lambda self, model: replace(lbs_score(self), terms={"all": factor * lbs_score(self).total}),
    )
    trained = train(judged := job(f"worse {factor}", replace(SHORT, iterations=2, static_fraction=0.0)), silent)
    provenance = load_model(judged.output).provenance
    assert provenance["worse_than_lbs"] is is_worse(trained.score, trained.lbs) is (factor > 1)
    assert provenance["lbs"]["total"] == trained.lbs.total
    told = worse_message("cape", trained.score, trained.lbs)
    assert factor == 1.0 or (told.level == "warning" and "280% above linear blend skinning's" in told.text)


def test_long_steps_are_reported_one_by_one(job, monkeypatch):
    events: list[Event] = []
    monkeypatch.setattr(training, "REPORT_INTERVAL", 0.0)
    train(job("long", replace(SHORT, iterations=4, static_fraction=0.0)), events.append)
    assert [event.done for event in events if isinstance(event, Progress)] == [1, 2, 3, 4]


def test_events_say_what_is_trained_and_how_it_goes(job, monkeypatch):
    monkeypatch.setattr(training, "REPORT_INTERVAL", math.inf)
    events: list[Event] = []
    train(job("events", replace(SHORT, iterations=40, validate_every=20)), events.append)
    (started,) = (event for event in events if isinstance(event, Started))
    before = [event.text for event in events[: events.index(started)] if isinstance(event, Message)]
    ways = "the body is posed in 3 motions", "the network and its inputs are built", "linear blend skinning is scored"
    assert [text.startswith(way) for text, way in zip(before, ways)] == [True] * 3
    assert started.total == 40 and started.detail["vertices"] == 60 and started.detail["proxies"] == 2
    progress = [event for event in events if isinstance(event, Progress)]
    assert [event.done for event in progress] == [1, 20, 40]
    assert progress[0].seconds_left is None and progress[-1].seconds_left > 0  # a validation is still to come
    assert set(progress[-1].terms) == {*TERMS, "drag"} - {"stitch"}  # a garment of one island has none
    judged = [event.text for event in events if isinstance(event, Message) and "validation at" in event.text]
    assert len(judged) == 2 and "under linear blend skinning's" in judged[0]


def test_provenance_tells_how_the_model_came_to_be(uninterrupted):
    provenance = load_model(uninterrupted.output).provenance
    assert provenance["train"]["window"] == 5 and provenance["seed"] == 7
    assert provenance["inputs"] == {"stage.usd": "abc"} and provenance["lowered"] == []
    assert provenance["motions"] == {"/a": [[0, 60, 30]], "/b": [[0, 45, 30]]}
    assert provenance["held out"] == {"/held": [[0, 40, 30]]}
    assert provenance["torch"] == torch.__version__ and provenance["libigl"] == version("libigl")
    assert provenance["device"].startswith("cpu")
    assert set(provenance["validation"]) >= {"stretch", "gravity", "total", "collisions"}
    json.dumps(provenance, allow_nan=False)


def test_a_diverging_run_says_so_and_keeps_the_best_model(job):
    """Smaller learning rates are tried once; these are too large even so."""
    wild = job(
        "diverging",
        replace(
            SHORT,
            iterations=20,
            static_fraction=0.5,
            validate_every=10,
            learning_rate=1e9,
            final_learning_rate=1e9,
            ema_decay=0.0,
        ),
    )
    events: list[Event] = []
    with pytest.raises(SsilkError, match=r"training diverged: .* at iteration 20 .*not finite.*kept") as error:
        train(wild, events.append)
    assert "resume" not in str(error.value)  # with another step size it would be another run
    (back,) = (
        e.text
        for e in events
        if isinstance(e, Message) and "back to iteration 10 with 25% of the learning rate" in e.text
    )
    assert str(fault_path(wild.output)) in back
    kept = load_model(wild.output)
    assert kept.provenance["iteration"] == 10 and all(np.isfinite(v).all() for v in kept.parameters.values())


def poison(monkeypatch: pytest.MonkeyPatch, bad: Callable[[Stepper, int], bool], name: str = "bending") -> None:
    """Make a term of the windows of some iterations NaN."""
    run, window, poisoned = Stepper.run, Objective.window, [False]

    def watched(self: Stepper, iteration: int) -> None:
        poisoned[0] = bad(self, iteration)
        run(self, iteration)

    def spoiled(self: Objective, sampler: WindowSampler, *drawn: torch.Tensor):
        dynamic, static, latents = window(self, sampler, *drawn)
        if poisoned[0]:
            kind = static if name.startswith("static ") else dynamic
            kind[name.removeprefix("static ")] = kind[name.removeprefix("static ")] * float("nan")
        return dynamic, static, latents

    monkeypatch.setattr(Stepper, "run", watched)
    monkeypatch.setattr(Objective, "window", spoiled)


def test_a_skipped_step_is_reported_by_term_and_iteration_and_counted_across_resumes(job, monkeypatch):
    spoiled = job("spoiled")
    with monkeypatch.context() as patch:
        poison(patch, lambda stepper, iteration: iteration == 7)
        train(spoiled, silent, stop_after(patch, 9))
    events: list[Event] = []
    poison(monkeypatch, lambda stepper, iteration: iteration in (11, 12), "static stretch")
    train(replace(spoiled, resume=True), events.append)
    told = [event.text for event in events if isinstance(event, Message) and "skipped" in event.text]
    assert told == [
        "2 steps up to iteration 13 were skipped: static stretch not finite.",
        "3 steps in total were skipped.",
    ]
    assert load_state(state_path(spoiled.output), spoiled.identity())[0].skipped == 3


@pytest.fixture
def watched_closely(monkeypatch):
    """Divergence is judged over a fifth of the usual steps."""
    for module in (divergence, training):
        monkeypatch.setattr(module, "DIVERGENCE_WINDOW", 20)
        monkeypatch.setattr(module, "CHECK_INTERVAL", 4)


@pytest.mark.usefixtures("watched_closely")
def test_many_skipped_steps_lead_back_to_the_last_state_and_smaller_steps(job, monkeypatch):
    config = replace(SHORT, iterations=18, static_fraction=0.0, validate_every=3)
    poison(
        monkeypatch,
        lambda stepper, iteration: iteration >= 3 and stepper.config.learning_rate == config.learning_rate,
    )
    events: list[Event] = []
    slowed = job("slowed", config)
    assert train(slowed, events.append).finished
    (back,) = (event.text for event in events if isinstance(event, Message) and "back to" in event.text)
    assert back.startswith("more than half of the last 20 steps were skipped at iteration 16 (bending not finite); ")
    assert "back to iteration 15 with 25% of the learning rate" in back
    state = load_state(state_path(slowed.output), slowed.identity())[0]
    assert [(item.iteration, item.pace) for item in state.lowered] == [(15, 0.25)]
    assert state.skipped == 13 and [point.iteration for point in state.curve] == [3, 6, 9, 12, 15, 18]
    kept = load_model(slowed.output).provenance["lowered"]
    assert [item["pace"] for item in kept] == ([0.25] if state.best.iteration > 15 else [])


@pytest.mark.usefixtures("watched_closely")
def test_what_stays_broken_stops_with_the_window_to_study(job, monkeypatch, scene):
    """Every window is spoiled; the step to iteration 12 is the last, as 12 is more than half of 20."""
    poison(monkeypatch, lambda stepper, iteration: True)
    broken = job(
        "broken", replace(SHORT, iterations=80, static_fraction=0.0, validate_every=1000, rotated_fraction=0.0)
    )
    with pytest.raises(
        SsilkError, match=r"skipped at iteration 12 \(bending.*no model yet.*broken.fault.safetensors"
    ):
        train(broken, silent)
    assert not broken.output.exists()
    with safe_open(fault_path(broken.output), "pt") as stream:
        document = json.loads(stream.metadata()["ssilk_fault"])
        window = {name: stream.get_tensor(f"window.{name}") for name in ("first", "direction", "latents", "noise")}
        assert "model.decoder.shapes" in stream.keys()  # noqa: SIM118
    assert document["iteration"] == 12 and len(document["places"]) == 3 == len(window["first"])
    assert window["direction"].tolist() == [[0, -1, 0]] * 3
    for place, first in zip(document["places"], window["first"].tolist()):
        assert place == ({"motion": "/a", "frame": first} if first < 60 else {"motion": "/b", "frame": first - 60})


def test_the_batch_is_lowered_to_fit_and_that_is_said(job, monkeypatch):
    small = job("lowered", replace(SHORT, batch=4000, pretraining_batch=90_000, iterations=1, static_fraction=0.0))
    monkeypatch.setattr(fitting_batch, "free_memory", lambda device: 1 << 30)
    events: list[Event] = []
    monkeypatch.setattr(Stepper, "run", lambda self, iteration: None)
    run = training.TrainingRun(small, events.append)
    assert 1 <= run.config.batch < 4000 and 1 <= run.config.pretraining_batch < 90_000
    (warning,) = (event for event in events if isinstance(event, Message) and event.level == "warning")
    assert f"from 4000 to {run.config.batch} windows" in warning.text
    started = next(event for event in events if isinstance(event, Started))
    assert started.detail["memory predicted [MiB]"] <= 0.8 * 1024
    assert run.stepper.sampler.first.shape == (run.config.batch,)


def test_a_run_lowered_to_fit_is_resumed_as_it_was(job, monkeypatch):
    """Free memory is never the same twice; the batch of a resumed run must be."""
    big = job(
        "refit",
        replace(SHORT, batch=4000, pretraining_batch=90_000, iterations=1, static_fraction=0.0, validate_every=1),
    )
    runs = []
    for megabytes in (400, 500, 330):
        monkeypatch.setattr(fitting_batch, "free_memory", lambda device, size=megabytes << 20: size)
        runs.append(training.TrainingRun(replace(big, resume=bool(runs)), silent).config)
    assert runs[0] == runs[1] == runs[2] and runs[0].batch < 4000


def test_a_batch_of_one_that_cannot_fit_is_refused(job, monkeypatch):
    monkeypatch.setattr(fitting_batch, "free_memory", lambda device: 30 << 20)
    with pytest.raises(SsilkError, match=r"/toy/strip: a batch of one window of 5 poses needs .* GiB are free"):
        train(job("tiny"), silent)


def limited(monkeypatch: pytest.MonkeyPatch, windows: int, poses: int) -> None:
    """Run out of memory above so many windows or single poses."""
    window, static = Objective.window, Objective.static

    def some(self: Objective, sampler: WindowSampler, *drawn: torch.Tensor):
        if len(sampler.first) > windows:
            raise torch.OutOfMemoryError("injected")
        return window(self, sampler, *drawn)

    def single(self: Objective, frames: torch.Tensor, *drawn):
        if len(frames) > poses:
            raise torch.OutOfMemoryError("injected")
        return static(self, frames, *drawn)

    monkeypatch.setattr(Objective, "window", some)
    monkeypatch.setattr(Objective, "static", single)


def test_a_run_that_is_out_of_memory_goes_on_with_half_the_batch(job, monkeypatch):
    big, events = job("big", replace(SHORT, batch=12, pretraining_batch=16)), []
    limited(monkeypatch, windows=3, poses=9)
    assert not train(big, events.append, stop_after(monkeypatch, 9)).finished
    told = [event.text for event in events if isinstance(event, Message) and "memory" in event.text]
    assert told == [
        "iteration 0: cpu is out of memory: the batch is reduced from 12 to 6 windows and from 16 to 8 single poses.",
        "iteration 4: cpu is out of memory: the batch is reduced from 6 to 3 windows and from 8 to 4 single poses.",
    ]
    assert not train(replace(big, resume=True), events.append, stop_after(monkeypatch, 1)).finished
    assert train(replace(big, resume=True), events.append).finished
    assert told == [event.text for event in events if isinstance(event, Message) and "memory" in event.text]
    assert [item["batch"] for item in load_model(big.output).provenance["lowered"]] == [6, 3]


def test_nothing_that_was_learned_is_lost_with_half_the_batch(job, monkeypatch):
    run = training.TrainingRun(job("halved", replace(SHORT, batch=8, pretraining_batch=8)), silent)
    for _ in range(6):
        run.step()
    before = learned_tensors(run.stepper)
    limited(monkeypatch, windows=2, poses=2)

    def looked_at(self: Stepper) -> None:
        self.objective.window(self.sampler, self.sampler.noise(), *self.sampler.poses(2)[:2])

    monkeypatch.setattr(Stepper, "dynamic_step", looked_at)
    run.step()
    after = learned_tensors(run.stepper)
    assert run.config.batch == len(run.stepper.sampler.first) == 2 and run.state.iteration == 7
    assert any(name.startswith("adam.") for name in before) and before.keys() == after.keys()
    assert all(torch.equal(value, after[name]) for name, value in before.items())


@pytest.mark.parametrize(("windows", "poses", "iteration"), [(9, 0, 0), (0, 9, 4)])
def test_a_run_that_is_out_of_memory_with_a_batch_of_one_stops(job, monkeypatch, windows, poses, iteration):
    limited(monkeypatch, windows, poses)
    with pytest.raises(
        SsilkError, match=rf"iteration {iteration}: cpu is out of memory with a batch of one; .*window"
    ):
        train(job(f"is_diverging{windows}"), silent)


def test_no_model_that_is_not_finite_is_written_where_a_run_is_interrupted(job, monkeypatch):
    score = validation.Validator.score
    monkeypatch.setattr(
        validation.Validator,
        "score",
        lambda self, model: replace(score(self, model), terms={"bending": float("nan")}),
    )
    early = job("early")
    with pytest.raises(SsilkError, match=r"not finite at iteration 2 \(bending not finite\); there is no model yet"):
        train(early, silent, stop_after(monkeypatch, 2))
    assert fault_path(early.output).exists() and state_path(early.output).exists() and not early.output.exists()


@pytest.fixture
def may_have(monkeypatch):
    """Sets how much memory of the GPU may be had, which no prediction knows of [bytes]."""
    if not torch.cuda.is_available():
        pytest.skip("needs a GPU")
    whole = torch.cuda.get_device_properties(0).total_memory
    monkeypatch.setattr(fitting_batch, "free_memory", lambda device: 1 << 50)
    yield lambda size: torch.cuda.set_per_process_memory_fraction(min(1.0, size / whole))
    torch.cuda.set_per_process_memory_fraction(1.0)


def test_a_gpu_that_is_out_of_memory_goes_on_with_half_the_batch(job, may_have):
    may_have(2 << 30)
    big = job("gpu", replace(SHORT, iterations=40, batch=100_000, pretraining_batch=1_000_000), device="cuda")
    assert train(big, silent).finished
    assert load_model(big.output).provenance["lowered"][-1]["batch"] < 50_000


def test_a_gpu_that_is_out_of_memory_in_a_graph_goes_on_with_half_the_batch(job, may_have, monkeypatch):
    """Memory is short for the first capture alone, which needs some of its own."""
    run = Stepper.run

    def short(self: Stepper, iteration: int) -> None:
        torch.cuda.empty_cache()
        first = iteration == EAGER_STEPS and self.config.batch == 5000
        may_have(torch.cuda.memory_reserved() + (8 << 20) if first else 1 << 50)
        run(self, iteration)

    monkeypatch.setattr(Stepper, "run", short)
    big = job("graph", replace(SHORT, iterations=20, batch=5000, static_fraction=0.0), device="cuda")
    assert train(big, silent).finished
    assert [item["batch"] for item in load_model(big.output).provenance["lowered"]] == [2500]


def test_a_state_is_saved_by_time_too(job, monkeypatch):
    saved, save = [], RunFiles.save_state

    def noted(self: RunFiles, stepper: Stepper, state: RunState) -> None:
        saved.append(state.iteration)
        save(self, stepper, state)

    monkeypatch.setattr(RunFiles, "save_state", noted)
    monkeypatch.setattr(training, "SAVE_INTERVAL", 0.0)
    train(job("timed"), silent)
    assert saved == [*range(15)]


def test_a_model_that_was_not_written_any_more_is_in_the_state(job, monkeypatch):
    """The process is killed between the state and the second model, at the validation that the state tells of."""
    totals, score = iter([3.0, 2.0, 1.0, 0.5]), validation.Validator.score
    monkeypatch.setattr(
        validation.Validator, "score", lambda self, model: replace(score(self, model), terms={"all": next(totals)})
    )
    killed, write = job("killed"), RunFiles.save_model

    def second(self: RunFiles, model: GarmentModel, state: RunState, score: Score, lbs: Score) -> None:
        if state.iteration == 10:
            raise InterruptedError
        write(self, model, state, score, lbs)

    with monkeypatch.context() as patch, pytest.raises(InterruptedError):
        patch.setattr(RunFiles, "save_model", second)
        train(killed, silent)
    assert load_model(killed.output).provenance["iteration"] == 5
    at_once = threading.Event()
    at_once.set()
    trained = train(replace(killed, resume=True), silent, at_once)
    rescued = load_model(killed.output).provenance
    assert (rescued["iteration"], rescued["validation"]["total"], trained.score.total) == (10, 2.0, 2.0)
    with safe_open(state_path(killed.output), "pt") as stream, safe_open(killed.output, "pt") as model:
        for name in model.keys():  # noqa: SIM118
            if name.startswith("model."):
                assert torch.equal(model.get_tensor(name), stream.get_tensor(name.replace("model.", "averaged.", 1)))


def test_a_model_that_is_gone_is_no_longer_the_best(job, monkeypatch):
    """The best one, of a validation before the last, is not there any more; the last one is written."""
    totals, score = iter([1.0, 2.0, 3.0]), validation.Validator.score
    monkeypatch.setattr(
        validation.Validator, "score", lambda self, model: replace(score(self, model), terms={"all": next(totals)})
    )
    lost = job("lost", replace(SHORT, iterations=4, validate_every=2, static_fraction=0.0))
    train(lost, silent)
    assert load_model(lost.output).provenance["iteration"] == 2
    lost.output.unlink()
    train(replace(lost, resume=True), silent)
    assert load_model(lost.output).provenance["iteration"] == 4


def test_the_learning_curve_goes_on_where_a_resumed_run_does(job, uninterrupted, monkeypatch):
    resumed = job("curve")
    train(resumed, silent, stop_after(monkeypatch, 7))
    first = json.loads(curve_path(resumed.output).read_text())
    train(replace(resumed, resume=True), silent)
    last = json.loads(curve_path(resumed.output).read_text())
    assert [point["iteration"] for point in last["points"]] == [5, 10, 14]
    assert last["points"][:1] == first["points"] and last["lbs"] == first["lbs"]
    assert 0 < last["points"][0]["seconds"] < last["points"][1]["seconds"] < last["points"][2]["seconds"]
    whole = json.loads(curve_path(uninterrupted.output).read_text())
    assert [p["validation"] for p in whole["points"]] == [p["validation"] for p in last["points"]]
    best = min(whole["points"], key=lambda point: point["validation"]["total"])
    provenance = load_model(uninterrupted.output).provenance
    assert (best["iteration"], best["validation"]) == (provenance["iteration"], provenance["validation"])
    assert best["batch"].keys() >= {"stretch", "inertia"}


def test_a_long_curve_is_thinned_and_ends_at_the_last_validation():
    curve: list[CurvePoint] = []
    for iteration in range(1, 5001):
        curve = append_point(curve, CurvePoint(iteration, iteration / 100, {}, Score({}, 0.0)))
        assert curve[-1].iteration == iteration and len(curve) <= 400
    assert curve[0].iteration == 1 and len(curve) > 200


def test_interrupts_set_the_event_once_and_are_immediate_the_second_time():
    started = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), stop_on_signals(silent) as stop:
        assert not stop.is_set()
        signal.raise_signal(signal.SIGINT)
        assert stop.wait(1)
        signal.raise_signal(signal.SIGINT)
        stop.clear()
        stop.wait(1)
    assert signal.signal(signal.SIGINT, started) is before


def test_interrupts_elsewhere_than_in_the_main_thread_are_left_alone():
    found: list[bool] = []

    def work() -> None:
        with stop_on_signals(silent) as stop:
            found.append(stop.is_set())

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert found == [False]


def test_motions_are_split_four_to_one(scene, toy_motion):
    motions = [toy_motion(scene, 10, path=f"/{i}") for i in range(11)]
    kept, held = split_motions(motions)
    assert [m.path for m in held] == ["/4", "/9"] and len(kept) == 9
    kept, held = split_motions(motions[:2])
    assert [m.path for m in kept] == ["/0"] and [m.path for m in held] == ["/1"]
    (kept,), (held,) = split_motions(motions[:1])
    assert (kept.frame_count, held.frame_count) == (8, 2)
    with pytest.raises(SsilkError, match="one motion of one frame"):
        split_motions([toy_motion(scene, 1)])


def test_devices_are_chosen_or_refused():
    assert select_device("cpu").type == "cpu"
    assert select_device("auto").type == ("cuda" if torch.cuda.is_available() else "cpu")
    for name in ("warp", "cuda:99"):
        with pytest.raises(SsilkError, match=rf"--device {name}: no such device here"):
            select_device(name)


def test_step_sizes_warm_up_and_decay_in_each_phase():
    config = TrainConfig(
        iterations=1000,
        static_fraction=0.4,
        static_learning_rate=1.0,
        learning_rate=0.5,
        final_learning_rate=0.01,
        learning_rate_warmup=10,
    )
    rates = [learning_rate(config, i) for i in range(1000)]
    assert rates[0] == pytest.approx(0.1) and rates[400] == pytest.approx(0.05)
    assert np.argmax(rates[:400]) < 15 and np.argmax(rates[400:]) < 15
    assert rates[399] == pytest.approx(0.1, rel=1e-3) and rates[999] == pytest.approx(0.01, rel=1e-2)
    assert rates[210] == pytest.approx(0.1 + 0.9 * 0.5 * (1 + np.cos(np.pi * 210 / 400)))


def test_nothing_else_is_left_beside_the_models(uninterrupted):
    assert not [path for path in Path(uninterrupted.output).parent.iterdir() if path.name.startswith(".")]


def test_a_validation_counts_the_skin_that_shows_in_frames_spread_over_all_clips(
    scene, toy_motion, toy_model, monkeypatch
):
    monkeypatch.setattr("ssilk_core.training.validation.SHOWN_FRAMES", (5, 5))
    clips = [toy_motion(scene, count, path=f"/clips/{name}.usdc:/Anim") for count, name in ((20, "a"), (30, "b"))]
    clips[1] = replace(clips[1], start=7)
    model, energy = toy_model(scene), GarmentEnergy(scene.garment.mesh, Fabric("toy"))
    body = CollisionBody(scene.character.merged_body(), 3, device=torch.device("cpu"))
    bank = build_bank(clips, scene.character.skeleton, model.joints, 30.0, torch.device("cpu"))
    validator = Validator(bank, energy, body, scene, model.decoder.rest, 30.0, 50, spans=clips)
    into = torch.tensor([[0.0], [0.0], [0.05]])  # into the ball, which is in front of the strip
    monkeypatch.setattr(model, "vertices", lambda z, character: validator.lbs_vertices(character) + into)
    found = validator.score(model).shown_skin
    picked = torch.tensor([5, 15, 25, 35, 45])
    character = bank.character(picked)
    skin = CoveredSkin(scene, device=torch.device("cpu"))
    shows = skin.states(validator.lbs_vertices(character) + into, character).shows
    shares = shows.double().mean(0)
    assert found.mean == pytest.approx(float(shares.mean())) and found.worst == pytest.approx(float(shares.max()))
    names = [("a", 5), ("a", 15), ("b", 12), ("b", 22), ("b", 32)]
    assert (found.clip, found.frame) == names[int(shares.argmax())] and found.frames == 5
    assert found.mean > 0.01 > validator.lbs_score().shown_skin.mean
    document = json.loads(json.dumps(asdict(validator.score(model))))
    assert Score.of(document).shown_skin == found


def test_a_validation_counts_triangles_that_intersect_in_frames_spread_over_its_clips(
    scene, toy_motion, toy_model, monkeypatch
):
    monkeypatch.setattr("ssilk_core.training.validation.CROSSED_FRAMES", 5)
    clips = [toy_motion(scene, count, path=f"/clips/{name}.usdc:/Anim") for count, name in ((20, "a"), (30, "b"))]
    model, energy = toy_model(scene), GarmentEnergy(scene.garment.mesh, Fabric("toy"))
    body = CollisionBody(scene.character.merged_body(), 3, device=torch.device("cpu"))
    bank = build_bank(clips, scene.character.skeleton, model.joints, 30.0, torch.device("cpu"))
    validator = Validator(bank, energy, body, scene, model.decoder.rest, 30.0, 50, spans=clips)
    crumpled = 0.1 * torch.randn(scene.garment.mesh.vertex_count, 3, 1, generator=torch.Generator().manual_seed(1))
    monkeypatch.setattr(model, "vertices", lambda z, character: validator.lbs_vertices(character) + crumpled)
    score = validator.score(model)
    x = validator.lbs_vertices(bank.character(torch.tensor([5, 15, 25, 35, 45]))) + crumpled
    shares = [validator.cloth.triangles(frame).mean() for frame in x.permute(2, 0, 1).double().numpy()]
    found = score.intersections
    assert (found.frames, found.mean, found.worst) == (5, pytest.approx(np.mean(shares)), max(shares))
    assert (found.clip, found.frame) == [("a", 5), ("a", 15), ("b", 5), ("b", 15), ("b", 25)][int(np.argmax(shares))]
    assert found.mean > 0.1 > validator.lbs_score().intersections.mean
    document = json.loads(json.dumps(asdict(score)))
    assert Score.of(document).intersections == found
    del document["intersections"]
    assert Score.of(document).intersections is None
    contours = IntersectionContours(validator.cloth, scene.classes, 0.5, torch.device("cpu"))
    weighed = Validator(
        bank, energy, body, scene, model.decoder.rest, 30.0, 50, spans=clips, contours=contours
    ).score(model)
    clips = torch.cat([torch.arange(0, 20, 4), torch.arange(20, 50, 4)])
    lengths = contours.lengths(validator.lbs_vertices(bank.character(clips)) + crumpled)
    mean = (20 * lengths[:5].mean() + 30 * lengths[5:].mean()) / 50  # frames that are searched stand for their clip
    assert weighed.terms["intersection"] == pytest.approx(0.5 * float(mean)) and lengths.min() > 0.1
    assert weighed.total == pytest.approx(score.total + weighed.terms["intersection"])


def test_a_model_that_is_hardly_trained_or_shows_skin_is_warned_of_with_what_goes_on(tmp_path, monkeypatch, capsys):
    skin = ShownSkin(
        frames=3, covered=100, mean=0.043, worst=0.102, bare=0.0, worst_bare=0.0, clip="c", frame=3, regions={}
    )
    shows, holds = (
        Score({"stretch": 0.1}, 0.0, shown_skin=each) for each in (skin, replace(skin, mean=4e-4, worst=4e-3))
    )
    assert shortcomings("skirt", holds, 500, 500, 360.0) is None
    told = shortcomings("skirt", holds, 100, 500, 360.0)
    assert told and "sufficed for 100 of 500 iterations" in told.text and "skin shows" not in told.text
    assert "'--resume --minutes 30' goes on" in told.text and told.level == "warning"
    told = shortcomings("skirt", shows, 500, 500, 360.0)
    assert (
        told and "4.30% of the covered skin shows, 10.2% in the worst frame, 0.00% is bare; what shows" in told.text
    )
    assert "iterations" not in told.text and "--minutes 12'" in told.text
    monkeypatch.chdir(tmp_path)
    for name in ("hero.usda", "walks"):
        (tmp_path / name).touch()
    model = tmp_path / "skirt.safetensors"
    trained = training.TrainingResult(True, 86, 80, shows, Score({"stretch": 1.0}, 0.0), True, 360.0)
    monkeypatch.setattr(training, "train", lambda *_: trained)
    ready = SimpleNamespace(train=TrainConfig(iterations=500), is_trainable=True, family=None)
    monkeypatch.setattr(command, "training_job", lambda *_: ready)
    words = ["train", "hero.usda", "--motions", "walks", "-o", str(model), "--device", "cpu"]
    assert main(words) == 0
    shown = capsys.readouterr().err
    assert "86 of 500 iterations" in shown and "iterations: 86\n  the model is of iteration: 80\n" in shown
    monkeypatch.setattr(training, "train", lambda *_: replace(trained, moves=False))
    assert main(words) == EXIT_WORSE and "it has not learned to move" in capsys.readouterr().err


def test_a_result_says_which_iteration_its_figures_are_of(job, monkeypatch):
    """The second of two validations is worse."""
    score, totals = Validator.score, iter([0.0, 1.0])

    def scored(validator, model):
        found = score(validator, model)
        return replace(found, terms={**found.terms, "stretch": found.terms["stretch"] + next(totals)})

    monkeypatch.setattr(Validator, "score", scored)
    asked = job("second_is_worse", replace(SHORT, iterations=8, validate_every=4))
    trained = train(asked, silent)
    assert (trained.iterations, trained.model_iteration) == (8, 4)
    assert load_model(asked.output).provenance["iteration"] == 4
    assert load_model(asked.output).provenance["validation"]["total"] == pytest.approx(trained.score.total)


def test_a_slow_training_has_a_model_before_its_first_validation(job, monkeypatch):
    """It is the model of that step, and does not count as the best one: the clock decides nothing."""
    monkeypatch.setattr(training, "FIRST_MODEL", 0.0)
    monkeypatch.setattr(training, "VALIDATION_SHARE", math.inf)
    heard: list[Event] = []
    asked = job("first_model", replace(SHORT, iterations=8, validate_every=8))
    train(asked, heard.append)
    written = [event.done for event in heard if isinstance(event, Checkpoint)]
    assert written[0] < 8 and len(written) == 2 and written[-1] == 8
    monkeypatch.undo()
    alone = job("first_model_later", asked.train)
    train(alone, silent)
    first, second = (load_model(each.output) for each in (asked, alone))
    assert all(np.array_equal(value, second.parameters[name]) for name, value in first.parameters.items())


@pytest.mark.parametrize(("load", "is_told"), [(2.5, True), (0.3, False)])
def test_cores_that_other_programs_take_are_told(job, monkeypatch, load, is_told):
    monkeypatch.setattr(training, "busy_cores", lambda: load)
    heard: list[Event] = []
    train(job(f"busy_{is_told}", replace(SHORT, iterations=1, static_fraction=0)), heard.append)
    said = [event.text for event in heard if isinstance(event, Message) and "other programs" in event.text]
    assert len(said) == is_told and all("about 2.5 on" in text for text in said)


def test_a_training_that_is_stopped_inside_a_step_says_from_where_it_goes_on(job, monkeypatch):
    def endless(stepper: Stepper, iteration: int) -> None:
        if iteration == 3:
            raise KeyboardInterrupt  # as `PatientStop` does
        run(stepper, iteration)

    run = Stepper.run
    asked = job("inside", replace(SHORT, iterations=6, validate_every=2))
    heard: list[Event] = []
    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(Stepper, "run", endless)
        train(asked, heard.append)
    said = [event.text for event in heard if isinstance(event, Message)]
    assert said[-1] == "stopped at once; --resume continues from iteration 2."
    assert train(replace(asked, resume=True), silent).iterations == 6


@pytest.mark.parametrize(("share", "text"), [(0.0345, "3.5%"), (-0.2, "20.0%"), (1.0, "100.0%"), (1.01, "over 100%")])
def test_a_total_below_zero_is_lower_by_no_more_than_all(share, text):
    assert percent(share) == text


@pytest.mark.parametrize(("total", "lbs", "share"), [(0.5, 1, 0.5), (-2, -1, 1), (-1, -2, -0.5), (1, 0, 0)])
def test_a_total_that_is_lower_counts_as_such_below_zero_too(total, lbs, share):
    assert share_below(total, lbs) == share
