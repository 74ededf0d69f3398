# SPDX-License-Identifier: Apache-2.0
"""Two processes that train one garment on the toy scene: one gradient, the same parameters, and exact resuming.

This file, run as a script, forks them, so that both have what it imported; they leave what they found, and the tests
look at that.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import socket
import subprocess
import sys
import threading
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from safetensors.torch import load_file

from ssilk_core import cli
from ssilk_core.errors import EXIT_OK, EXIT_WORSE, SsilkError
from ssilk_core.events import silent
from ssilk_core.network.checkpoint import load_model
from ssilk_core.network.settings import ModelConfig
from ssilk_core.scene.fabrics import Fabric
from ssilk_core.training import parallel
from ssilk_core.training import run as training
from ssilk_core.training.job import TrainJob
from ssilk_core.training.parallel import TORCHRUN_VARIABLES, ProcessGroup, join_process_group
from ssilk_core.training.run import TrainingRun, train
from ssilk_core.training.settings import TrainConfig
from ssilk_core.training.state import state_path
from ssilk_core.training.validation import Score

SHORT = TrainConfig(
    iterations=8, static_fraction=0.3, pretraining_batch=8, batch=4, window=5, static_batch=8,
    learning_rate_warmup=2, ema_decay=0.9, validate_every=4, valid_frames=12, seed=7,
)  # fmt: skip
# Without noise, a step depends on where the windows stand and on nothing drawn.
ONE_STEP = replace(SHORT, static_fraction=0.0, noise=0.0)


class Recorder:
    """Shares gradients as a run does, and keeps a copy of what it gave back."""

    def __init__(self, run: TrainingRun) -> None:
        self.share, self.given = run.stepper.average_gradients, []
        run.stepper.average_gradients = self

    def __call__(self, gradients: list[torch.Tensor]) -> None:
        if self.share is not None:
            self.share(gradients)
        self.given.append([gradient.clone() for gradient in gradients])


# --- in each of the processes -------------------------------------------------------------------------------------


def poses(run: TrainingRun, first: int, count: int) -> None:
    """Let a run look at certain single poses instead of drawing them."""
    down = torch.tensor([0.0, -1.0, 0.0]).expand(count, 3)
    run.stepper.sampler.poses = lambda _: (torch.arange(first, first + count), down, down)


def shared_gradient(job: TrainJob, group: ProcessGroup) -> dict[str, object]:
    """Where every process's windows stood after three steps, and the gradient of the fourth."""
    run = TrainingRun(replace(job, train=ONE_STEP), silent, group)
    for iteration in range(3):
        run.stepper.run(iteration)
    before = group.gather({name: value.clone() for name, value in run.stepper.sampler.state().items()})
    parameters = [value.detach().clone() for value in run.stepper.model.parameters()]
    recorder, half = Recorder(run), ONE_STEP.static_batch // group.size
    poses(run, group.rank * half, half)
    run.stepper.run(3)
    return {"samplers": before, "parameters": parameters, "gradient": recorder.given[0]}


def skipped_step(job: TrainJob, group: ProcessGroup) -> dict[str, object]:
    """The parameters before and after a step in which only the last process found no number."""
    run = TrainingRun(replace(job, train=ONE_STEP), silent, group)

    def poisoned(gradients: list[torch.Tensor]) -> None:
        if not group.is_first:
            gradients[0][0] = float("nan")
        group.average(gradients)

    run.stepper.average_gradients = poisoned
    before = [value.detach().clone() for value in run.stepper.model.parameters()]
    run.stepper.run(0)
    return {"before": before, "after": [value.detach() for value in run.stepper.model.parameters()]}


class SecondLook(threading.Event):
    """An event that is set from the second look on."""

    def __init__(self) -> None:
        super().__init__()
        self.looked = False

    def is_set(self) -> bool:
        looked, self.looked = self.looked, True
        return looked


def resumed(job: TrainJob, group: ProcessGroup) -> list[tuple[bool, int]]:
    """Train, the last process alone being asked to stop, and resume; how both ended."""
    stop = threading.Event() if group.is_first else SecondLook()
    ends = [train(job, silent, stop, group), train(replace(job, resume=True), silent, None, group)]
    return [(trained.finished, trained.iterations) for trained in ends]


def main(folder: Path, rank: str) -> None:
    os.environ |= {"RANK": rank, "LOCAL_RANK": rank}
    torch.set_num_threads(1)
    training.CHECK_INTERVAL = 4  # iterations after which processes agree to stop
    job: TrainJob = pickle.loads((folder / "job").read_bytes())
    with join_process_group("cpu") as (group, device):
        job = replace(job, device=device)
        whole = replace(job, output=folder / "whole.safetensors")
        found = {
            "one step": shared_gradient(whole, group),
            "skipped": skipped_step(whole, group),
            "trained": train(whole, silent, None, group),
            "resumed": resumed(replace(job, output=folder / "halves.safetensors"), group),
        }
        torch.save(found, folder / f"{group.rank}.pt")


# --- in the test's process ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def job(scene, toy_motion, tmp_path_factory) -> TrainJob:
    return TrainJob(
        scene=scene,
        motions=[toy_motion(scene, 60, path="/a"), toy_motion(scene, 45, speed=1.7, path="/b")],
        held_out=[toy_motion(scene, 40, speed=speed, path=f"/{speed}") for speed in (1.3, 0.7, 0.9)],
        model=ModelConfig(latent=6, widths=(16,), shapes=3),
        train=SHORT,
        fabric=Fabric("toy", bending=1e-4),
        output=tmp_path_factory.mktemp("together") / "model.safetensors",
        device="cpu",
    )


@pytest.fixture(scope="module")
def together(job) -> list[dict]:
    """What two processes found, which ran at the same time."""
    folder = job.output.parent
    (folder / "job").write_bytes(pickle.dumps(job))
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    told = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "WORLD_SIZE": "2", "OMP_NUM_THREADS": "1"}
    subprocess.run([sys.executable, __file__, folder], env={**os.environ, **told}, timeout=100, check=True)
    return [torch.load(folder / f"{rank}.pt", weights_only=False) for rank in range(2)]


def test_two_halves_of_a_batch_give_the_gradient_of_the_whole(job, together):
    ours, theirs = (found["one step"] for found in together)
    alone = TrainingRun(replace(job, train=ONE_STEP), silent)
    first, second = ours["samplers"]
    assert not torch.equal(first["first"], second["first"])
    slots = {name: (first[name], second[name]) for name in ("first", "direction", "carried")}
    state = {name: torch.cat(halves) for name, halves in slots.items()}
    latents = torch.cat([first["latents"], second["latents"]], dim=1)
    alone.stepper.sampler.restore({**state, "latents": latents, "generator": first["generator"]})
    with torch.no_grad():
        for value, trained in zip(alone.stepper.model.parameters(), ours["parameters"]):
            value.copy_(trained)
    recorder = Recorder(alone)
    poses(alone, 0, ONE_STEP.static_batch)
    alone.stepper.run(3)
    assert len(recorder.given[0]) == len(ours["gradient"])
    for whole, mine, other in zip(recorder.given[0], ours["gradient"], theirs["gradient"]):
        assert torch.equal(mine, other)
        torch.testing.assert_close(mine, whole, rtol=1e-4, atol=1e-5 * float(whole.abs().max()) + 1e-9)


def test_parameters_stay_alike_bit_for_bit(together):
    ours, theirs = (found["one step"]["parameters"] for found in together)
    assert all(torch.equal(mine, other) for mine, other in zip(ours, theirs))


def test_a_step_that_one_cannot_do_is_skipped_by_all(together):
    for found in together:
        assert all(torch.equal(a, b) for a, b in zip(found["skipped"]["before"], found["skipped"]["after"]))


def test_all_know_the_same_score(together):
    ours, theirs = (found["trained"] for found in together)
    assert ours == theirs and ours.finished and ours.iterations == 8


def test_one_that_is_asked_to_stop_stops_all_and_a_resumed_run_equals_a_whole_one(job, together):
    assert together[0]["resumed"] == together[1]["resumed"] == [(False, 4), (True, 8)]
    whole, halves = (job.output.parent / f"{name}.safetensors" for name in ("whole", "halves"))
    assert halves.read_bytes() == whole.read_bytes()
    ours, theirs = (load_file(state_path(path)) for path in (halves, whole))
    assert ours.keys() == theirs.keys() and any(name.startswith("sampler.1.") for name in ours)
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)


def test_a_run_is_resumed_by_as_many_processes(job, together):
    whole = job.output.parent / "whole.safetensors"
    assert load_model(whole).provenance["processes"] == 2
    with pytest.raises(SsilkError, match=r"another processes.*a resumed run repeats the same command"):
        train(replace(job, output=whole, resume=True), silent)


def test_each_process_draws_its_own(job):
    seeds = [ProcessGroup(rank, 8).seed(seed) for rank in range(8) for seed in (0, 1, 2)]
    assert seeds[:3] == [0, 1, 2] and len(set(seeds)) == 24
    assert all(torch.Generator().manual_seed(seed).initial_seed() == seed for seed in seeds)


def test_batches_are_divided_equally_or_refused():
    assert ProcessGroup(1, 2).local_config(SHORT) == replace(SHORT, batch=2, pretraining_batch=4, static_batch=4)
    with pytest.raises(SsilkError, match=r"setting 'batch': 4 for 3 processes; .*a multiple of 3"):
        ProcessGroup(0, 3).local_config(replace(SHORT, pretraining_batch=9))


def test_that_another_process_has_ended_is_told(monkeypatch):
    def broken(*given: object) -> None:
        raise RuntimeError("[pair.cc:1] Connection closed by peer. This is\nnews")

    for name in ("all_reduce", "all_gather_object"):
        monkeypatch.setattr(torch.distributed, name, broken)
    for exchange in (lambda: ProcessGroup(1, 2).average([torch.zeros(1)]), lambda: ProcessGroup(1, 2).any(True)):
        with pytest.raises(SsilkError, match=r"^process 2 of 2: .*\(\[pair.cc:1\] Connection closed by peer\); read"):
            exchange()


def test_without_torchrun_a_process_is_alone(monkeypatch):
    for name in TORCHRUN_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    with join_process_group("cuda:5") as (group, device):
        assert group == ProcessGroup() and device == "cuda:5"


def test_torchrun_gives_out_the_devices(monkeypatch):
    for name, value in zip(TORCHRUN_VARIABLES, "112"):
        monkeypatch.setenv(name, value)
    with pytest.raises(SsilkError, match=r"--device cuda:0: torchrun gives each process a GPU of its own"):
        join_process_group("cuda:0").__enter__()
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    with pytest.raises(SsilkError, match=r"process 2: 1 GPUs are visible; .*--nproc-per-node 1"):
        join_process_group("auto").__enter__()


@pytest.mark.parametrize("rank", [0, 1])
@pytest.mark.parametrize(("total", "code"), [(2.0, EXIT_WORSE), (0.5, EXIT_OK)])
def test_each_process_of_a_group_tells_that_a_model_is_worse_than_none(tmp_path, monkeypatch, rank, total, code):
    trained = SimpleNamespace(
        score=Score({"stretch": total}, 0.0),
        lbs=Score({"stretch": 1.0}, 0.0),
        iterations=1,
        model_iteration=1,
        moves=True,
        finished=True,
        seconds=1.0,
    )
    job = SimpleNamespace(train=SimpleNamespace(iterations=1), is_trainable=True, family=None)
    monkeypatch.setattr(parallel, "join_process_group", lambda device: nullcontext((ProcessGroup(rank, 2), "cpu")))
    monkeypatch.setattr("ssilk_core.training.run.train", lambda *_: trained)
    monkeypatch.setattr("ssilk_core.cli.train.training_job", lambda *_: job)
    monkeypatch.chdir(tmp_path)
    for name in ("stage.usda", "clip.usda"):
        (tmp_path / name).touch()
    words = ["train", "stage.usda", "--motions", "clip.usda", "-o", str(tmp_path / "model.safetensors")]
    assert cli.main(words) == code


if __name__ == "__main__":
    torch.optim.SGD([torch.zeros(1)])  # imports what optimisers need, which takes seconds
    fork = multiprocessing.get_context("fork")
    processes = [fork.Process(target=main, args=(Path(sys.argv[1]), rank)) for rank in "01"]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    sys.exit(any(process.exitcode for process in processes))
