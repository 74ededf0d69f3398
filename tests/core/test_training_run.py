# SPDX-License-Identifier: Apache-2.0
"""Whole training runs on the toy scene: learning, stopping, resuming, running out of memory, diverging."""

import json
import os
import signal
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ssilk_core.checkpoint import load_model
from ssilk_core.config import ModelConfig, TrainConfig
from ssilk_core.devices import chosen_device
from ssilk_core.errors import SsilkError
from ssilk_core.events import Checkpoint, Event, Message, Progress, Started, silent
from ssilk_core.fabrics import Fabric
from ssilk_core.training import run as training
from ssilk_core.training.run import TrainJob, interruptible, split_motions, train
from ssilk_core.training.state import state_path
from ssilk_core.training.step import Stepper, learning_rate

SHORT = TrainConfig(
    iterations=14,
    warm=0.3,
    warm_batch=6,
    batch=3,
    window=5,
    rate_warmup=2,
    average=0.9,
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


def test_training_lowers_the_energy_of_held_out_motion(job):
    config = replace(SHORT, iterations=110, warm=0.6, warm_batch=16, warm_rate=6e-3, rate=2e-3, surface="vertices")
    trained = train(job("learning", config), silent)
    assert trained.finished and trained.iterations == 110
    assert trained.score.total < 0.8 * trained.plain.total
    assert trained.plain.dynamics == 0 < trained.score.dynamics
    assert trained.plain.terms["gravity"] == pytest.approx(0, abs=1e-6)


def test_a_run_repeats_bit_for_bit(job, uninterrupted):
    again = job("again")
    train(again, silent)
    assert again.output.read_bytes() == uninterrupted.output.read_bytes()
    assert state_path(again.output).read_bytes() == state_path(uninterrupted.output).read_bytes()


@pytest.mark.parametrize("stops", [[2], [4], [5], [9], [3, 4, 4], [13]])
def test_a_resumed_run_equals_an_uninterrupted_one_bit_for_bit(job, uninterrupted, monkeypatch, stops):
    resumed = job("-".join(map(str, stops)))
    for index, steps in enumerate(stops):
        with monkeypatch.context() as patch:
            trained = train(replace(resumed, resume=index > 0), silent, stop_after(patch, steps))
        assert not trained.finished and trained.iterations == sum(stops[: index + 1])
        load_model(resumed.output)
    trained = train(replace(resumed, resume=True), silent)
    assert trained.finished
    assert resumed.output.read_bytes() == uninterrupted.output.read_bytes()
    assert state_path(resumed.output).read_bytes() == state_path(uninterrupted.output).read_bytes()


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


def test_damaged_or_missing_states_are_refused(job, uninterrupted):
    missing = job("missing", resume=True)
    with pytest.raises(SsilkError, match="there is no training to resume"):
        train(missing, silent)
    whole = state_path(uninterrupted.output).read_bytes()
    for size in (0, 5, 100, len(whole) // 2, len(whole) - 1):
        state_path(missing.output).write_bytes(whole[:size])
        with pytest.raises(SsilkError, match=r"the training state is damaged .*delete it"):
            train(missing, silent)


def test_the_best_model_is_kept(job, monkeypatch):
    """Validation totals are replaced by ones that fall, then rise."""
    totals, score = iter([3.0, 1.0, 2.0, 5.0]), training.Validator.score
    monkeypatch.setattr(
        training.Validator, "score", lambda self, model: replace(score(self, model), terms={"all": next(totals)})
    )
    events: list[Event] = []
    kept = job("best", replace(SHORT, validate_every=4, iterations=16, warm=0.0))
    trained = train(kept, events.append)
    assert [event.done for event in events if isinstance(event, Checkpoint)] == [4, 8]
    assert trained.score.total == 1.0
    assert load_model(kept.output).provenance["iteration"] == 8


def test_events_say_what_is_trained_and_how_it_goes(job):
    events: list[Event] = []
    train(job("events", replace(SHORT, iterations=40, validate_every=20)), events.append)
    (started,) = (event for event in events if isinstance(event, Started))
    assert started.total == 40 and started.detail["vertices"] == 60 and started.detail["proxies"] == 2
    progress = [event for event in events if isinstance(event, Progress)]
    assert [event.done for event in progress] == [1, 20, 40]
    assert progress[-1].seconds_left == 0
    assert set(progress[-1].terms) == {"stretch", "bending", "gravity", "inertia", "collision", "drag"}
    judged = [event.text for event in events if isinstance(event, Message) and "validation at" in event.text]
    assert len(judged) == 2 and "under plain skinning's" in judged[0]


def test_provenance_tells_how_the_model_came_to_be(uninterrupted):
    provenance = load_model(uninterrupted.output).provenance
    assert provenance["train"]["window"] == 5 and provenance["seed"] == 7
    assert provenance["inputs"] == {"stage.usd": "abc"} and provenance["motions"] == ["/a", "/b"]
    assert provenance["torch"] == torch.__version__ and provenance["device"].startswith("cpu")
    assert set(provenance["validation"]) >= {"stretch", "gravity", "total", "collisions"}
    json.dumps(provenance, allow_nan=False)


def test_a_diverging_run_says_so_and_keeps_the_best_model(job):
    wild = job(
        "diverging", replace(SHORT, iterations=20, warm=0.5, validate_every=10, rate=1e9, final_rate=1e9, average=0.0)
    )
    with pytest.raises(SsilkError, match=r"training diverged by iteration 20; .*kept") as error:
        train(wild, silent)
    assert "resume" not in str(error.value)  # with another step size it would be another run
    kept = load_model(wild.output)
    assert kept.provenance["iteration"] == 10 and all(np.isfinite(v).all() for v in kept.parameters.values())


def test_steps_whose_gradient_is_not_finite_are_left_out_and_counted(job, monkeypatch):
    step, count = training.Stepper.warm, [0]

    def poisoned(self: Stepper) -> None:
        count[0] += 1
        if count[0] == 2:
            hook = self.model.output[-1].bias.register_hook(lambda gradient: gradient * float("nan"))
            before = [value.detach().clone() for value in self.model.decoder.parameters()]
            self.optimiser.state.clear()  # no momentum, so that a step that is left out moves nothing
            step(self)
            hook.remove()
            assert all(torch.equal(a, b) for a, b in zip(before, self.model.decoder.parameters()))
        else:
            step(self)

    monkeypatch.setattr(training.Stepper, "warm", poisoned)
    events: list[Event] = []
    train(job("poisoned", replace(SHORT, iterations=6, warm=0.6)), events.append)
    assert any(isinstance(e, Message) and e.text.startswith("1 steps were left out") for e in events)


def test_the_batch_is_lowered_to_fit_and_that_is_said(job, monkeypatch):
    small = job("lowered", replace(SHORT, batch=4000, warm_batch=90_000, iterations=1, warm=0.0))
    monkeypatch.setattr(training, "free_memory", lambda device: 1 << 30)
    events: list[Event] = []
    monkeypatch.setattr(Stepper, "run", lambda self, iteration: None)
    run = training.Run(small, events.append)
    assert 1 <= run.job.train.batch < 4000 and 1 <= run.job.train.warm_batch < 90_000
    warning = next(event for event in events if isinstance(event, Message))
    assert warning.level == "warning" and f"from 4000 to {run.job.train.batch} windows" in warning.text
    started = next(event for event in events if isinstance(event, Started))
    assert started.detail["memory predicted [MiB]"] <= 0.8 * 1024
    assert run.stepper.sampler.first.shape == (run.job.train.batch,)


def test_a_run_lowered_to_fit_is_resumed_as_it_was(job, monkeypatch):
    """Free memory is never the same twice; the batch of a resumed run must be."""
    big = job("refit", replace(SHORT, batch=4000, warm_batch=90_000, iterations=1, warm=0.0, validate_every=1))
    runs = []
    for megabytes in (400, 500, 330):
        monkeypatch.setattr(training, "free_memory", lambda device, size=megabytes << 20: size)
        run = training.Run(replace(big, resume=bool(runs)), silent)
        if runs:
            run.resume()
        run.save_state()
        runs.append(run.job.train)
    assert runs[0] == runs[1] == runs[2] and runs[0].batch < 4000


def test_interrupts_set_the_event_once_and_are_immediate_the_second_time():
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), interruptible() as stop:
        assert not stop.is_set()
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.wait(1)
        os.kill(os.getpid(), signal.SIGINT)
        stop.clear()
        stop.wait(1)
    assert signal.getsignal(signal.SIGINT) is before


def test_interrupts_elsewhere_than_in_the_main_thread_are_left_alone():
    found: list[bool] = []

    def work() -> None:
        with interruptible() as stop:
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
    assert chosen_device("cpu").type == "cpu"
    assert chosen_device("auto").type == ("cuda" if torch.cuda.is_available() else "cpu")
    for name in ("warp", "cuda:99"):
        with pytest.raises(SsilkError, match=rf"--device {name}: no such device here"):
            chosen_device(name)


def test_step_sizes_warm_up_and_decay_in_each_phase():
    config = TrainConfig(iterations=1000, warm=0.4, warm_rate=1.0, rate=0.5, final_rate=0.01, rate_warmup=10)
    rates = [learning_rate(config, i) for i in range(1000)]
    assert rates[0] == pytest.approx(0.1) and rates[400] == pytest.approx(0.05)
    assert np.argmax(rates[:400]) < 15 and np.argmax(rates[400:]) < 15
    assert rates[399] == pytest.approx(0.1, rel=1e-3) and rates[999] == pytest.approx(0.01, rel=1e-2)
    assert rates[210] == pytest.approx(0.1 + 0.9 * 0.5 * (1 + np.cos(np.pi * 210 / 400)))


def test_nothing_else_is_left_beside_the_models(uninterrupted):
    assert not [path for path in Path(uninterrupted.output).parent.iterdir() if path.name.startswith(".")]
