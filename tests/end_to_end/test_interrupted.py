# SPDX-License-Identifier: Apache-2.0
"""Trainings that are killed without warning, at any moment: nothing is damaged, and they end as if nobody had."""

from __future__ import annotations

import json
import multiprocessing
import os
import random
import shlex
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file

from ssilk_core.cli import main
from ssilk_core.errors import EXIT_OK, EXIT_WORSE
from ssilk_core.network.checkpoint import load_model
from ssilk_core.physics import samples

TRAINED = (EXIT_OK, EXIT_WORSE)  # so few iterations may do no good
pytestmark = pytest.mark.skipif(os.name != "posix", reason="processes are forked, and killed by a signal")

# Files are written after every step, and steps are so large that some models are the best so far and some are not.
SETTINGS = (
    "iterations=14 static_fraction=0.1 validate_every=1 learning_rate=0.004 final_learning_rate=0.004 "
    "learning_rate_warmup=0 ema_decay=0"
)
FEW_CONTACTS = 0.1  # [m], as `few_contacts` has it
MODEL, STATE, CURVE = Path("model.safetensors"), Path("model.resume.safetensors"), Path("model.curve.json")


def train(command: Sequence[str], fatal: int | None = None, late: bool = False) -> None:
    """Run a command; be killed where a file gets its name for the time `fatal`, before or after (`late`) it does."""
    torch.set_num_threads(1)
    samples.MAX_SPACING = FEW_CONTACTS  # as in this process: both have the same loss
    rename, count = Path.replace, 0

    def fatally(self: Path, target: Path) -> Path:
        nonlocal count
        count += 1
        if count == fatal and not late:
            os.kill(os.getpid(), signal.SIGKILL)
        renamed = rename(self, target)
        if count == fatal:
            os.kill(os.getpid(), signal.SIGKILL)
        return renamed

    Path.replace = fatally  # type: ignore[method-assign]
    sys.exit(main([*command, "--resume"] if STATE.exists() else [*command]))


@pytest.fixture(scope="module")
def forks():
    """Makes processes at once: modules are loaded, and nothing has been computed."""
    forks = multiprocessing.get_context("forkserver")
    forks.set_forkserver_preload(
        [
            *("ssilk_core.cli.train", "ssilk_core.training.run"),
            *("ssilk_usd.reading.character", "ssilk_usd.reading.motion"),
            *("torch._dynamo", "safetensors.torch", "scipy.spatial", "scipy.sparse.csgraph"),
        ]
    )
    return forks


@pytest.fixture(scope="module")
def command(toy) -> list[str]:
    files = f"train {toy.folder}/rigged.usda --motions {toy.folder}/clip.usda -o {MODEL} --json"
    return [*shlex.split(files), *toy.training, *(word for pair in SETTINGS.split() for word in ("--set", pair))]


@pytest.fixture(scope="module")
def whole(command, tmp_path_factory) -> Path:
    """The folder of a training that was left alone."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder := tmp_path_factory.mktemp("whole"))
        torch.set_num_threads(1)
        assert main(command) in TRAINED
    return folder


def check_files() -> None:
    """Every file that has its name can be loaded and agrees with the others; the rest is named as unfinished."""
    names = {path.name for path in Path().iterdir()}
    unfinished = tuple(f".{path.stem}.partial-" for path in (MODEL, STATE, CURVE))
    assert all(name.startswith(unfinished) for name in names - {str(path) for path in (MODEL, STATE, CURVE)})
    if CURVE.exists():
        assert json.loads(CURVE.read_text())["lbs"]
    if STATE.exists():
        check_best()


def check_best() -> None:
    """The best model is on disk, or the state is that of the best model, which is then written anew."""
    with safe_open(STATE, "pt") as stream:
        state = json.loads(stream.metadata()["ssilk_state"])
        assert all(stream.get_tensor(name) is not None for name in stream.keys())  # noqa: SIM118
    made = load_model(MODEL).provenance if MODEL.exists() else {"iteration": None}
    if (best := state["best"]) and made["iteration"] != best["iteration"]:
        assert best["iteration"] == state["iteration"]
    elif best:
        assert sum(best["score"]["terms"].values()) == made["validation"]["total"]


def check_equal(whole: Path) -> None:
    """Nothing tells the files from those of a training that was left alone, but the time that was taken."""
    assert sorted(path.name for path in Path().iterdir()) == sorted(path.name for path in whole.iterdir())
    assert MODEL.read_bytes() == (whole / MODEL).read_bytes()
    tensors, others = load_file(STATE), load_file(whole / STATE)
    assert tensors.keys() == others.keys()
    assert all(torch.equal(value, others[name]) for name, value in tensors.items())
    curve, other = (json.loads(path.read_text()) for path in (CURVE, whole / CURVE))
    assert [point | {"seconds": 0} for point in curve["points"]] == [p | {"seconds": 0} for p in other["points"]]


@pytest.mark.slow
def test_killed_wherever_a_file_gets_its_name(forks, command, whole, tmp_path, monkeypatch):
    """Resumed ones write a model that was lost, and the curve; each step then a state, a curve, and maybe a model."""
    monkeypatch.chdir(tmp_path)
    places = [*((count, False) for count in (1, 3, 5, 7)), *((count, True) for count in range(1, 7)), (None, False)]
    codes = []
    for place in places:
        process = forks.Process(target=train, args=(command, *place))
        process.start()
        process.join(60)
        codes.append(process.exitcode)
        check_files()
    assert codes[:-1] == [-signal.SIGKILL] * (len(places) - 1) and codes[-1] in TRAINED
    check_equal(whole)


def test_killed_at_any_time(forks, command, whole, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    dice, began = random.Random(2), []
    for kill in (True, True, True, False):
        before = STATE.stat().st_mtime_ns if STATE.exists() else 0
        process = forks.Process(target=train, args=(command,))
        process.start()
        while kill and process.is_alive() and (STATE.stat().st_mtime_ns if STATE.exists() else 0) == before:
            time.sleep(0.001)
        time.sleep(dice.uniform(0, 0.3) if kill else 0)
        if kill:
            process.kill()
        process.join(60)
        check_files()
        began.append(len(json.loads(CURVE.read_text())["points"]) if CURVE.exists() else 0)
    assert process.exitcode in TRAINED and began == sorted(began) and began[0] < began[-2] < 14
    check_equal(whole)
