# SPDX-License-Identifier: Apache-2.0
"""Measure bakes in bulk: shots on a local cluster whose workers are killed at random, cores, and a long soak.

    python benchmarks/farm.py cape.safetensors --stage cape.usdc --motion 01_walk.usdc 07_run_2.usdc

Each shot is some frames of one of the motions. One process bakes a share of the shots undisturbed; on the cluster,
a worker is killed every few seconds. Then every shot must be there once, and those of the share hold the same bytes.
The soak bakes one shot again and again in one process, whose memory and file handles are watched.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from helpers.processes import resident, workers
from helpers.reports import table, write_results
from ssilk_usd.reading.character import read_character
from ssilk_usd.reading.motion import read_motion
from ssilk_usd.writing.files import write_motion

from ssilk_core.delivery.bake import BakeRequest, BakeTask, LayerFolder, plan_layers
from ssilk_core.delivery.farm.cluster import bake_here, run_on_cluster
from ssilk_core.files import sha256
from ssilk_core.scene.assets import Motion

PERIOD = 10.0  # seconds from one kill to the next; a worker takes a few to start
PARTS = ("cluster", "cores", "start", "soak")
SHARE = 25  # shots that are compared byte by byte


@dataclass
class Killer:
    """Kills workers of the cluster that this process started, and watches their memory.

    Attributes:
        killed: how many.
        memory: most that a worker took [MiB], for each tenth of the time.
    """

    kill: bool
    killed: int = 0
    memory: list[tuple[float, float]] = field(default_factory=list)
    over: threading.Event = field(default_factory=threading.Event)

    def run(self) -> None:
        """Kill and monitor until it is over."""
        began, choice = time.monotonic(), random.Random(0)
        while not self.over.wait(PERIOD):
            busy = workers(os.getpid())
            self.memory.append((time.monotonic() - began, max(map(resident, busy), default=0.0)))
            if self.kill and busy:
                os.kill(choice.choice(busy), signal.SIGKILL)
                self.killed += 1


def main() -> None:
    """Measure and write the tables."""
    options = _options()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tasks = plan_layers(_requests(options, folder))
        measured: dict[str, dict[str, Any]] = {}
        if "cluster" in options.parts:
            measured["cluster"] = _on_cluster(tasks, folder)
        if "cores" in options.parts:
            measured["cores"] = _cores(tasks[: options.scaling], folder, options.cores)
        if "start" in options.parts:
            measured["start"] = _start(tasks[0], folder)
        if "soak" in options.parts:
            measured["soak"] = _soak(tasks[0], folder, options.soak)
    rows = [[name, value] for part in measured.values() for name, value in part.items()]
    write_results(options, table(["what", "measured"], rows), measured)


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", help="trained model")
    parser.add_argument("--stage", required=True, help="USD file with its character")
    parser.add_argument("--motion", nargs="+", required=True, help="USD files with motions")
    parser.add_argument("--shots", type=int, default=500, help="to bake (default 500)")
    parser.add_argument("--frames", type=int, default=60, help="of each (default 60)")
    parser.add_argument("--scaling", type=int, default=48, help="shots baked by each number of cores (default 48)")
    parser.add_argument("--cores", type=int, nargs="+", default=[1, 2, 4], help="numbers of cores (default 1 2 4)")
    parser.add_argument("--soak", type=int, default=10_000, help="bakes of one shot (default 10,000)")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS, help="what to measure (default: all)")
    parser.add_argument("--name", default="farm", help="of the results (default farm)")
    parser.set_defaults(device="cpu", threads=torch.get_num_threads())
    return parser.parse_args()


def _requests(options: argparse.Namespace, folder: Path) -> list[BakeRequest]:
    stage = str(Path(options.stage).absolute())
    shots = _shots(options, folder)
    return [BakeRequest(model=options.model, stage=stage, motion=motion) for motion in shots]


def _shots(options: argparse.Namespace, folder: Path) -> list[str]:
    """Write the motions of the shots, each from another frame on."""
    skeleton = read_character(options.stage).skeleton
    motions = [read_motion(motion, skeleton) for motion in options.motion]
    paths = []
    for shot in range(options.shots):
        path = folder / f"shot_{shot:04d}.usdc"
        write_motion(path, _part(motions[shot % len(motions)], shot, options.frames), skeleton)
        paths.append(str(path))
    return paths


def _part(motion: Motion, shot: int, frames: int) -> Motion:
    start = shot % max(motion.frame_count - frames, 1)
    return replace(motion.clip(start, start + frames), start=0.0)


def _on_cluster(tasks: Sequence[BakeTask], folder: Path) -> dict[str, Any]:
    """Bake all tasks while workers are killed; return what became of them."""
    killer = Killer(kill=True)
    monitor = threading.Thread(target=killer.run)
    monitor.start()
    began = time.perf_counter()
    outcomes = list(run_on_cluster(tasks, folder / "cluster", bake_here))
    seconds = time.perf_counter() - began
    cluster = LayerFolder(folder / "cluster")
    cluster.remove_unfinished(tasks)
    killer.over.set()
    monitor.join()
    names = Counter(outcome.task.name for outcome in outcomes if not outcome.error)
    half = len(killer.memory) // 2
    return {
        "shots": len(tasks),
        "seconds": round(seconds, 1),
        "workers killed": killer.killed,
        "shots lost": len(tasks) - sum(cluster.is_done(task) for task in tasks),
        "shots ended twice": sum(count > 1 for count in names.values()),
        "shots that differ from an undisturbed bake": _differing(tasks, folder),
        "shots compared": min(SHARE, len(tasks)),
        "half-written files": sum(1 for path in (folder / "cluster").rglob(".*partial-*") if path.is_file()),
        "largest worker in the first half [MiB]": round(max((size for _, size in killer.memory[:half]), default=0)),
        "largest worker in the second half [MiB]": round(max((size for _, size in killer.memory[half:]), default=0)),
    }


def _differing(tasks: Sequence[BakeTask], folder: Path) -> int:
    """Return how many of a share of the tasks hold other bytes than one process makes undisturbed."""
    single, cluster, differing = LayerFolder(folder / "single"), LayerFolder(folder / "cluster"), 0
    for task in random.Random(1).sample(list(tasks), min(SHARE, len(tasks))):
        single.bake(task)
        places = [layers.layout(task) for layers in (single, cluster)]
        there = places[1].animation.is_file()  # those that are not are counted as lost
        differing += there and len({sha256(place.animation) for place in places}) > 1
    return differing


def _cores(tasks: Sequence[BakeTask], folder: Path, cores: Sequence[int]) -> dict[str, Any]:
    """Return the rate of numbers of cores, without what starting a cluster and its workers takes."""
    rates: dict[str, Any] = {}
    for count in cores:
        outcomes = run_on_cluster(tasks, folder / f"cores_{count}", bake_here, cores=count)
        for _ in range(count):  # each worker has loaded the model
            next(outcomes)
        began = time.perf_counter()
        done = len(list(outcomes))
        rates[f"shots per second, cores: {count}"] = round(done / (time.perf_counter() - began), 2)
    return {**rates, "load of the machine meanwhile": round(os.getloadavg()[1], 1)}


def _start(task: BakeTask, folder: Path) -> dict[str, Any]:
    """Return what a process takes before its first shot, and for a shot then [s]."""
    words = "import torch, ssilk_usd.shots.shot, ssilk_usd.checking.shot, ssilk_core.delivery.bake"
    layers, taken = LayerFolder(folder / "first"), [time.perf_counter()]
    for work in (
        lambda: subprocess.run([sys.executable, "-c", words], check=True),
        lambda: layers.garment(task),
        lambda: layers.bake(task),
        lambda: layers.bake(task, again=True),
    ):
        work()
        taken.append(time.perf_counter())
    names = ("to start Python and its modules", "to load the model and its character",
             "for the first shot, its asset included", "for another shot")  # fmt: skip
    return {f"seconds {name}": round(float(each), 2) for name, each in zip(names, np.diff(taken))}


def _soak(task: BakeTask, folder: Path, bakes: int) -> dict[str, Any]:
    """Bake one shot again and again; return memory ten times, how it grows between, and file handles."""
    layers, step = LayerFolder(folder / "soak"), max(bakes // 10, 1)
    memory, handles = {}, {}
    for count in range(1, bakes + 1):
        layers.bake(task, again=True)
        if count % step == 0:
            memory[count], handles[count] = resident(os.getpid()), len(os.listdir("/proc/self/fd"))
    slope = np.polyfit(list(memory)[1:], list(memory.values())[1:], 1)[0] * 1024  # once everything is warm
    return {
        **{f"memory after {count:,} bakes [MiB]": round(size, 1) for count, size in memory.items()},
        "growth of memory in each bake after the first fifth, by least squares [KiB]": round(float(slope), 2),
        "file handles, least and most": f"{min(handles.values())}, {max(handles.values())}",
    }


if __name__ == "__main__":
    main()
