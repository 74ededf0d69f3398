# SPDX-License-Identifier: Apache-2.0
"""Bake shots on a local Ray cluster whose processes are killed at random, while inputs are published anew.

    python benchmarks/disturbed_farm.py --shots 500

'ssilk farm --cluster' bakes the shipped cape in short shots. At random times a worker, the command itself (the
driver) or the raylet is killed, or the motions of some shots or the model are replaced. The operator gives the same
command again, until it ends well and nothing was published since. Then all shots must be there once, with what the
inputs hold now. So must have been every shot that was done on the way: the hashes of its files are those of an
undisturbed bake of the same inputs. Each shot is then re-skinned, as by 'ssilk verify'. Linux only.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from helpers.processes import raylets, workers
from helpers.reports import table, write_results
from pxr import Usd, UsdSkel
from ssilk_usd.reading.character import read_character
from ssilk_usd.stages import demo_body_path
from ssilk_usd.writing.files import write_motion

from ssilk_core.delivery.bake import BakeRequest, BakeTask, LayerFolder, plan_layers, verify
from ssilk_core.delivery.bake.inputs import InputHashes
from ssilk_core.delivery.bake.record import current_record, read_record, task_key
from ssilk_core.demo.motions import demo_shot
from ssilk_core.demo.shipped import shipped_path
from ssilk_core.errors import EXIT_OK, EXIT_TASKS, SsilkError
from ssilk_core.events import Event, Message
from ssilk_core.files import sha256
from ssilk_core.network.checkpoint import load_model, save_model

SHAPE_SCALES = (1.0, 0.9, 1.1)  # of the blendshapes, one for each version of the model
MOTIONS = 20  # versions of a motion, of which each shot begins with another
AT_ONCE = 0.02  # share of the shots whose motions are published together
COMMANDS = 200  # that are given at most
WHILE_STARTING = 0.2  # how often a cluster is disturbed that bakes nothing yet, where it could be
SECONDS = 1800.0  # after which a command counts as hung


@dataclass(frozen=True)
class Versions:
    """What the inputs of a shot hold: the number of the model's version, and of the motion's."""

    model: int
    motion: int


class Show:
    """A folder with a model, a stage, motions and layers; inputs are published in it by renaming."""

    def __init__(self, folder: Path, library: Path, shots: int) -> None:
        self.library, self.folder = library, folder
        self.motions = [folder / f"motions/shot_{shot:04d}.usdc" for shot in range(shots)]
        self.model, self.stage = folder / "cape.safetensors", folder / "body.usdc"
        self.layers = folder / "layers"
        self.now = [Versions(0, shot % MOTIONS) for shot in range(shots)]
        self.motions[0].parent.mkdir(parents=True)
        shutil.copy(demo_body_path(), self.stage)
        self.publish_model(0)
        for shot, versions in enumerate(self.now):
            self.publish_motion(shot, versions.motion)
        requests = [BakeRequest(model=str(self.model), stage=str(self.stage), motion=str(m)) for m in self.motions]
        self.tasks = plan_layers(requests)

    def publish_model(self, version: int) -> None:
        """Replace the model."""
        _publish(self.library / f"model_{version}.safetensors", self.model)
        self.now = [replace(versions, model=version) for versions in self.now]

    def publish_motion(self, shot: int, version: int) -> None:
        """Replace the motion of a shot."""
        _publish(self.library / f"motion_{version}.usdc", self.motions[shot])
        self.now[shot] = replace(self.now[shot], motion=version)

    def key(self, shot: int, versions: Versions) -> str:
        """Return the key that the record of a shot ought to have."""
        paths = (
            self.library / f"model_{versions.model}.safetensors",
            self.library / f"motion_{versions.motion}.usdc",
        )
        model, motion = map(_digest, paths)
        return task_key(self.tasks[shot], InputHashes(model=model, stage=_digest(self.stage), motion=motion))

    def done(self) -> Iterator[tuple[int, str, Mapping[str, str]]]:
        """Yield number, key and hashes of the files of each shot that its record says is done."""
        for shot, task in enumerate(self.tasks):
            home = self.home(task)
            record = read_record(home)
            if record and current_record(home, record.key):
                yield shot, record.key, record.files

    def home(self, task: BakeTask) -> Path:
        """Return where the layers of a task lie."""
        return self.layers / "shots" / task.shot / task.garment


_DIGESTS: dict[Path, str] = {}


def _digest(path: Path) -> str:
    """Return the SHA-256 of a file that stays as it is."""
    if path not in _DIGESTS:
        _DIGESTS[path] = sha256(path)
    return _DIGESTS[path]


def _publish(source: Path, target: Path) -> None:
    temporary = target.with_name(f"new_{target.name}")
    shutil.copyfile(source, temporary)
    temporary.replace(target)


class Disturber(threading.Thread):
    """Kills and publishes at random while an operator gives commands.

    Attributes:
        left: what is still to be done, in a random order; what is impossible at the moment waits.
        done: how often each was done.
        published: how many publications there were.
    """

    def __init__(self, show: Show, counts: Mapping[str, int], period: float) -> None:
        super().__init__(daemon=True)
        self.show, self.period, self.random = show, period, random.Random(0)
        self.left = [kind for kind, count in counts.items() for _ in range(count)]
        self.random.shuffle(self.left)
        self.done: Counter[str] = Counter()
        self.published = 0
        self.driver: subprocess.Popen[str] | None = None

    def run(self) -> None:
        """Disturb until nothing is left to do."""
        while self.left:
            time.sleep(self.random.uniform(0, 2 * self.period))
            for kind in dict.fromkeys(self.left):
                if self._disturb(kind):
                    self.left.remove(kind)
                    self.done[kind] += 1
                    break

    def _disturb(self, kind: str) -> bool:
        """Do one thing; return whether it was possible."""
        if kind == "model":
            self.published += 1
            self.show.publish_model((self.show.now[0].model + 1) % len(SHAPE_SCALES))
            return True
        if kind == "motions":
            self.published += 1
            count = max(1, round(AT_ONCE * len(self.show.tasks)))
            for shot in self.random.sample(range(len(self.show.tasks)), count):
                self.show.publish_motion(shot, (self.show.now[shot].motion + 1) % MOTIONS)
            return True
        driver = self.driver
        if driver is None or driver.poll() is not None:
            return False
        busy = workers(driver.pid)
        found = {"worker": busy, "raylet": raylets(driver.pid), "driver": [driver.pid]}[kind]
        if not found or (not busy and self.random.random() > WHILE_STARTING):
            return False
        try:
            os.kill(self.random.choice(found), signal.SIGKILL)
        except ProcessLookupError:  # it ended meanwhile
            return False
        return True


def main() -> None:
    """Disturb a farm, look what became of the shots, and write the table."""
    options = _options()
    with tempfile.TemporaryDirectory() as name:
        measured = _measured(options, Path(name).resolve())
    write_results(options, table(["what", "measured"], [*measured.items()]), measured)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shots", type=int, default=500, help="to bake (default 500)")
    parser.add_argument("--frames", type=int, default=8, help="of each (default 8)")
    parser.add_argument("--period", type=float, default=6.0, help="mean time between disturbances [s] (default 6)")
    for name, what, count in (
        ("worker", "workers to kill", 40),
        ("driver", "drivers to kill", 8),
        ("raylet", "raylets to kill", 8),
        ("motions", "publications of motions", 15),
        ("model", "publications of the model", 2),
    ):
        parser.add_argument(f"--{name}", type=int, default=count, help=f"{what} (default {count})")
    parser.add_argument("--name", default="disturbed_farm", help="of the results (default disturbed_farm)")
    parser.set_defaults(device="cpu", threads=torch.get_num_threads())
    return parser.parse_args()


def _measured(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    _write_library(folder / "library", options.frames)
    show = Show(folder / "show", folder / "library", options.shots)
    counts = {kind: getattr(options, kind) for kind in ("worker", "driver", "raylet", "motions", "model")}
    disturber = Disturber(show, counts, options.period)
    began = time.monotonic()
    seen, told = _operate(show, disturber)
    minutes = (time.monotonic() - began) / 60
    files = {(shot, show.key(shot, versions)): versions for shot, versions in enumerate(show.now)}
    print(f"{minutes:.1f} minutes; {len(seen)} states to compare", file=sys.stderr)
    differing, unknown = _compared(seen, Show(folder / "quiet", folder / "library", options.shots))
    last = {(shot, key) for shot, key, _ in show.done()}
    return {
        "shots": options.shots,
        "frames of each": options.frames,
        "minutes": round(minutes, 1),
        "workers killed": disturber.done["worker"],
        "drivers killed": disturber.done["driver"],
        "raylets killed": disturber.done["raylet"],
        "publications of motions": disturber.done["motions"],
        "publications of the model": disturber.done["model"],
        **told,
        "shots lost": len(files.keys() - last),
        "shots twice": _doubled(show),
        "shots unreadable": sum(not _is_readable(show, task) for task in show.tasks),
        "done states compared with an undisturbed bake": len(seen),
        "of these, with other bytes": differing,
        "of these, with a key of no inputs": unknown,
        "shots re-skinned": options.shots,
        "of these, shots that differ": sum(not _is_verified(show, task) for task in show.tasks),
        "half-written files": sum(".partial-" in path.name for path in show.layers.rglob(".*") if path.is_file()),
    }


def _write_library(folder: Path, frames: int) -> None:
    """Write all versions of the inputs."""
    folder.mkdir()
    skeleton = read_character(demo_body_path()).skeleton
    whole, model = demo_shot(skeleton), load_model(shipped_path("cape"))
    for number, scale in enumerate(SHAPE_SCALES):
        parameters = {**model.parameters, "decoder.shapes": scale * model.parameters["decoder.shapes"]}
        save_model(folder / f"model_{number}.safetensors", replace(model, parameters=parameters), pack=True)
    for number in range(MOTIONS):
        start = number * (whole.frame_count - frames) // MOTIONS
        part = replace(whole.clip(start, start + frames), start=0.0)
        write_motion(folder / f"motion_{number}.usdc", part, skeleton)


def _operate(show: Show, disturber: Disturber) -> tuple[dict[tuple[int, str], Mapping[str, str]], dict[str, Any]]:
    """Give the same command until all shots are done; return the done states seen on the way, and what was told."""
    seen: dict[tuple[int, str], Mapping[str, str]] = {}
    said: Counter[str] = Counter()
    disturber.start()
    for number in range(1, COMMANDS + 1):
        published = disturber.published
        code, failures, result = _command(show, disturber)
        said.update(_kind(text) for text in failures)
        for shot, key, files in show.done():
            if seen.setdefault((shot, key), files) != files:
                raise RuntimeError(f"two bakes of {show.tasks[shot].name} under one key have other files")
        print(f"command {number}: exit code {code}, {dict(result)}, {len(failures)} failed, {len(disturber.left)} "
              f"disturbances left", file=sys.stderr)  # fmt: skip
        if code not in (EXIT_OK, EXIT_TASKS, -signal.SIGKILL):
            raise RuntimeError(f"exit code {code}: {failures[-1:]}")
        if code == EXIT_OK and not disturber.left and published == disturber.published:
            _, _, again = _command(show, disturber)
            return seen, {"commands": number, **said, "shots baked once more by the same command": again["baked"]}
    raise RuntimeError(f"the shots are not done after {COMMANDS} commands")


def _command(show: Show, disturber: Disturber) -> tuple[int, list[str], Mapping[str, Any]]:
    """Bake all shots on a cluster; return the exit code, what failed, and what became of the others."""
    words = ["farm", str(show.model), "--stage", str(show.stage), "--motion", *map(str, show.motions),
             "-o", str(show.layers), "--cluster", "--json"]  # fmt: skip
    process = subprocess.Popen([sys.executable, "-m", "ssilk_core", *words], stdout=subprocess.PIPE, text=True)
    disturber.driver = process
    heard, _ = process.communicate(timeout=SECONDS)
    events = list(map(json.loads, heard.splitlines()))
    failures = [event.get("said", event)["error"] for event in events if _event(event) == "failed"]
    results = [event["detail"] for event in events if _event(event) == "result"]
    return process.returncode, failures, results[-1] if results else {}


def _event(event: Mapping[str, Any]) -> str:
    return str(event.get("said", event)["event"])


def _kind(text: str) -> str:
    """Return what a task failed for."""
    for part, kind in (
        ("has changed since the job was submitted", "tasks refused because an input was published"),
        ("run the same command again", "tasks given up because the cluster ended too often"),
        ("its workers died", "tasks given up because their workers died too often"),
    ):
        if part in text:
            return kind
    raise RuntimeError(text)


def _compared(seen: Mapping[tuple[int, str], Mapping[str, str]], quiet: Show) -> tuple[int, int]:
    """Return how many states have other files than an undisturbed bake, and how many a key of no inputs."""
    versions = [Versions(model, motion) for model in range(len(SHAPE_SCALES)) for motion in range(MOTIONS)]
    known = {(shot, quiet.key(shot, each)): each for shot in {shot for shot, _ in seen} for each in versions}
    layers, differing = LayerFolder(quiet.layers), 0
    for shot, key in sorted(seen.keys() & known.keys(), key=lambda state: known[state].model):
        if quiet.now[shot].model != known[shot, key].model:
            quiet.publish_model(known[shot, key].model)
        quiet.publish_motion(shot, known[shot, key].motion)
        layers.bake(quiet.tasks[shot])
        record = read_record(quiet.home(quiet.tasks[shot]))
        differing += record is None or record.key != key or record.files != seen[shot, key]
    return differing, len(seen.keys() - known.keys())


def _doubled(show: Show) -> int:
    """Return how many shots or layers there are beside those that were asked for."""
    wanted = {show.home(task) / "anim.usdc" for task in show.tasks}
    return len({*(show.layers / "shots").glob("*/*/*.usd*")} - wanted) + sum(
        _garments(show, task) > 1 for task in show.tasks
    )


def _garments(show: Show, task: BakeTask) -> int:
    """Return how many garments' skeletons the stage of a shot holds; 0 where it cannot be read."""
    stage = Usd.Stage.Open(str(show.home(task).parent / "shot.usda"))
    if stage.GetCompositionErrors():
        return 0
    return sum(prim.IsA(UsdSkel.Root) for prim in stage.Traverse())


def _is_readable(show: Show, task: BakeTask) -> bool:
    return _garments(show, task) > 0


def _is_verified(show: Show, task: BakeTask) -> bool:
    """Return whether the layer of a task is, re-skinned, what its inputs give."""
    warnings: list[str] = []

    def report(event: Event) -> None:
        if isinstance(event, Message):
            warnings.append(event.text)

    try:
        verify(show.home(task) / "anim.usdc", report=report)
    except SsilkError as error:
        warnings.append(str(error))
    for text in warnings:
        print(text, file=sys.stderr)
    return not warnings


if __name__ == "__main__":
    main()
