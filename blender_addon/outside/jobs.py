# SPDX-License-Identifier: GPL-3.0-or-later
"""Trainings that outlive Blender: a folder each, in which a runner keeps their state."""

from __future__ import annotations

import getpass
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..errors import SetupError
from .process import environment
from .runner import BEAT, CANCEL, ORDER, STATE
from .wording import BONES, recall, reworded, with_bones

MODEL, TRAINING_STATE = "model.safetensors", "model.resume.safetensors"  # both as `ssilk train` writes them
OWNER = "training.json"  # what is trained, as `own` wrote it
CURVE = "model.curve.json"  # what validations found, as `ssilk train` writes it beside the model
RUNNER = Path(__file__).with_name("runner.py")
SILENCE = 10 * BEAT  # seconds without a beat after which a runner is no more

# How a process goes on when Blender and its terminal end; elsewhere a session of its own does that.
if sys.platform == "win32":
    DETACHED = subprocess.DETACHED_PROCESS | subprocess.CREATE_NEW_PROCESS_GROUP
else:
    DETACHED = 0


@dataclass(frozen=True)
class OwnedJob:
    """A job and what it trains; it stays what it is, whatever becomes of that.

    Attributes:
        garment, file: names of the garment and of the blend file, when the job was made.
        begun: when that was [s].
    """

    folder: Path
    garment: str
    file: str
    begun: float


@dataclass(frozen=True)
class JobState:
    """What a runner said of its training.

    Attributes:
        state: waiting, running, done, stopped or failed; lost where a runner ended without a word.
        done, total: iterations.
        seconds_left: None until it can be estimated.
        terms: energies of the last batch [J] by name; None where one is not finite.
        curve: [iteration, terms] now and then.
        checkpoint: iteration of the model on disk; None before there is one.
        text: the last message, in an artist's words.
        error: why it failed, likewise.
        cancelled: whether it was asked to end.
        round: how often it went on to improve after it was done.
        spent: time spent in trainings so far [s].
    """

    state: str
    done: int = 0
    total: int = 0
    seconds_left: float | None = None
    terms: dict[str, float | None] = field(default_factory=dict)
    curve: list[tuple[int, dict[str, float | None]]] = field(default_factory=list)
    checkpoint: int | None = None
    text: str = ""
    error: str = ""
    beat: float = 0.0
    cancelled: bool = False
    round: int = 0
    spent: float = 0.0

    @property
    def fraction(self) -> float:
        """The part that is done, in [0, 1]; all of it where the time was up before the last iteration."""
        if self.state == "done":
            return 1.0
        return self.done / self.total if self.total else 0.0

    @property
    def alive(self) -> bool:
        """Whether somebody works on it, or waits to."""
        return self.state in ("waiting", "running")


def create(parent: Path, name: str) -> Path:
    """Make a new folder for a job; return it.

    Args:
        name: begins the folder's name; a number follows.

    Raises:
        SetupError: it cannot be made.
    """
    number = 1
    while (folder := parent / f"{name}-{number:03d}").exists():
        number += 1
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        raise SetupError(
            f"{folder} cannot be made ({error.strerror or error}); save the blend file elsewhere."
        ) from error
    return folder


def own(folder: Path, garment: str, file: str) -> None:
    """Say what a job trains: names of a garment and of its blend file."""
    _write(folder / OWNER, {"garment": garment, "file": file, "begun": time.time()})


def owned(parent: Path) -> list[OwnedJob]:
    """Return the jobs in a folder that say what they train, the latest one last."""
    folders = [path.parent for path in parent.glob(f"*/{OWNER}")]
    found = [job for folder in folders if (job := owner(folder))]
    return sorted(found, key=lambda job: (job.begun, job.folder))


def owner(folder: Path) -> OwnedJob | None:
    """Return a job with what it trains; None where it does not say."""
    document = _read(folder / OWNER)
    garment, file, begun = (document.get(name) for name in ("garment", "file", "begun"))
    if not (isinstance(garment, str) and isinstance(file, str) and isinstance(begun, int | float)):
        return None
    return OwnedJob(folder, garment, file, float(begun))


def begin(python: str, folder: Path, command: Sequence[str], *, improves: bool = False) -> None:
    """Let a job begin when its turn comes.

    Args:
        python: the Python that has ssilk.
        command: arguments of that Python, run in the job's folder.
        improves: whether it goes on after it is done, until it is cancelled (see `runner`).

    Raises:
        SetupError: the Python cannot be started.
    """
    _write(folder / ORDER, {"command": list(command), "improves": improves})
    _launch(python, folder)


def models_beneath(folder: Path) -> list[Path]:
    """Return the models that a job's garment is trained over, as it was begun."""
    command = _read(folder / ORDER).get("command", [])
    given = [command[at + 1] for at, word in enumerate(command[:-1]) if word == "--over"]
    return [Path(os.path.normpath(folder / path)) for path in given]


def resume(python: str, folder: Path) -> None:
    """Let a job go on where it ended; it begins again where that was before it had written anything.

    Raises:
        SetupError: it works already, its files are gone, or the Python cannot be started.
    """
    state, order = read_state(folder), _read(folder / ORDER)
    if not order:
        raise SetupError(f"There is no training in {folder} any more; train again.")
    if state and state.alive:
        raise SetupError("The training is under way already.")
    command = [word for word in order["command"] if word != "--resume"]
    again = ["--resume"] if (folder / TRAINING_STATE).is_file() else []
    _write(folder / ORDER, {**order, "command": [*command, *again]})
    _launch(python, folder)


def _launch(python: str, folder: Path) -> None:
    """Start a runner, which outlives Blender."""
    (folder / CANCEL).unlink(missing_ok=True)
    _write(folder / STATE, {**_read(folder / STATE), "state": "waiting", "beat": time.time(), "error": ""})
    try:
        subprocess.Popen(
            [python, str(RUNNER), str(folder), str(queue_folder())], cwd=folder, env=environment(),
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
            creationflags=DETACHED,
        )  # fmt: skip
    except OSError as error:
        raise SetupError(f"{python} cannot be started ({error.strerror or error}); choose another Python.") from error


def cancel(folder: Path) -> None:
    """Ask a job to end; the best model and the state are kept."""
    (folder / CANCEL).touch()


def queue_folder() -> Path:
    """Return where the runners of this user line up."""
    return Path(tempfile.gettempdir()) / f"ssilk-queue-{getpass.getuser()}"


def read_state(folder: Path) -> JobState | None:
    """Return the state of a job; None where there is none."""
    fields = _read(folder / STATE)
    known = {name: fields[name] for name in JobState.__dataclass_fields__ if name in fields}
    if "state" not in known:
        return None
    if said := {name: known[name] for name in ("text", "error") if known.get(name)}:
        names, bones = recall(folder), recall(folder, BONES)
        known.update({name: with_bones(reworded(text, folder, names), bones) for name, text in said.items()})
    known["cancelled"] = (folder / CANCEL).exists()
    state = JobState(**known)
    if state.alive and time.time() - state.beat > SILENCE:
        return JobState(**{**known, "state": "lost"})
    return state


def stamp(folder: Path) -> float:
    """Return when a job's state was written last; zero where there is none."""
    path = folder / STATE
    return path.stat().st_mtime if path.exists() else 0.0


def read_curve(folder: Path) -> dict[str, Any]:
    """Return the curve beside a job's model, {"lbs": score, "points": [...]}; empty before there is one."""
    return _read(folder / CURVE)


def _read(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):  # not there yet, or not any more
        return {}
    return document if isinstance(document, dict) else {}


def _write(path: Path, document: dict[str, Any]) -> None:
    temporary = path.with_suffix(".partial")
    temporary.write_text(json.dumps(document), encoding="utf-8")
    os.replace(temporary, path)
