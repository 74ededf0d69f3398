# SPDX-License-Identifier: Apache-2.0
"""Count what bakes ask of a shared disk, and bake on one that is slow: every file operation waits.

    python benchmarks/shared_disk.py

The shipped cape is baked in some shots by 1, 2 and 4 processes, each of which takes an equal part as one chunk, and
checked afterwards. Linux and strace are needed: it counts the calls of all code, USD's own too, and delays them. What
Python loads to start is neither counted nor delayed, because it lies elsewhere.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from helpers.reports import table, write_results
from ssilk_usd.reading.character import read_character
from ssilk_usd.stages import demo_body_path
from ssilk_usd.writing.files import write_motion

from ssilk_core.delivery.bake import BakeRequest, BakeTask, plan_layers
from ssilk_core.delivery.bake.inputs import InputContents
from ssilk_core.delivery.farm.job import FarmJob, read_job, submitted, write_job
from ssilk_core.demo.motions import demo_shot
from ssilk_core.demo.shipped import shipped_path
from ssilk_core.events import silent

CALLS = "openat,newfstatat,statx,access,faccessat2,readlink,rename,unlink,mkdir,chmod,getdents64,fsync"
READY = "import os, signal, sys, torch, ssilk_core.cli; "
READY += "import ssilk_usd.shots.layers_asset, ssilk_usd.shots.layers_stage, "
READY += "ssilk_usd.checking.shot, ssilk_usd.reading.motion; "
WORK = READY + "os.kill(os.getpid(), signal.SIGSTOP); sys.exit(ssilk_core.cli.main(sys.argv[1:]))"
JOB_TASKS = 50_000  # of a large job, whose file is written to see how large it is


class Worker:
    """A process that runs a command while its file operations are counted and delayed."""

    def __init__(self, words: Sequence[str], folder: Path, log: Path, delay: float) -> None:
        self.folder, self.log = folder, log
        self.process = _quiet([sys.executable, "-c", WORK, *words])
        os.waitid(os.P_PID, self.process.pid, os.WSTOPPED | os.WNOWAIT)
        inject = f"inject={CALLS}:delay_enter={round(delay * 1e6)}"
        tracing = ["strace", "-f", "-y", "-qq", "-e", f"trace={CALLS}", "-e", inject, "-o", str(log)]
        self.tracer = _quiet([*tracing, "-p", str(self.process.pid)])
        while not re.search(r"TracerPid:\t[1-9]", Path(f"/proc/{self.process.pid}/status").read_text()):
            time.sleep(0.01)

    def start(self) -> None:
        """Let it run."""
        os.kill(self.process.pid, signal.SIGCONT)

    def wait(self) -> None:
        """Wait for its end; raise `RuntimeError` where it fails."""
        if self.process.wait() != 0:
            raise RuntimeError(f"exit code {self.process.returncode}")
        self.tracer.wait()

    def counts(self) -> tuple[int, int]:
        """Return how many operations there were on files of the folder, and in all."""
        lines = [line for line in self.log.read_text(errors="replace").splitlines() if "(DELAYED)" in line]
        return sum(str(self.folder) in line for line in lines), len(lines)


def _quiet(words: Sequence[str]) -> subprocess.Popen[bytes]:
    return subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def main() -> None:
    """Measure and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--shots", type=int, default=16, help="to bake (default 16)")
    parser.add_argument("--frames", type=int, default=24, help="of each (default 24)")
    parser.add_argument("--delay", type=float, default=0.01, help="of each file operation [s] (default 0.01)")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2, 4], help="processes (default 1 2 4)")
    parser.set_defaults(name="shared_disk", device="cpu", threads=torch.get_num_threads())
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        measured = _measured(options, Path(name).resolve())
    rows = [[what, *values.values()] for what, values in measured["runs"].items()]
    write_results(options, table(["run", *next(iter(measured["runs"].values()))], rows), measured)


def _measured(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    _write_shots(options, folder)
    runs: dict[str, Any] = {}
    out = folder / "layers_1"
    for count in options.workers:
        out = folder / f"layers_{count}"
        share = options.shots // count
        chunks = [f"{first}-{first + share - 1}" for first in range(0, share * count, share)]
        commands = [["task", str(folder / "job.json"), "-o", str(out), "--tasks", chunk] for chunk in chunks]
        runs[f"bake, workers: {count}"] = _run(commands, folder, options.delay)
    words = ["task", str(folder / "job.json"), "-o", str(out)]
    runs["bake again"] = _run([words], folder, options.delay)
    runs["check"] = _run([[*words, "--check"]], folder, options.delay)
    sizes = {
        "model": folder / "cape.safetensors",
        "stage": folder / "body.usdc",
        "motion": folder / "shot_000.usdc",
        "layer of a shot": out / "shots/shot_000/cape/anim.usdc",
        "asset": out / "assets/cape/geometry.usdc",
    }
    return {
        "shots": options.shots,
        "delay of a file operation [s]": options.delay,
        "runs": runs,
        "bytes": {what: path.stat().st_size for what, path in sizes.items()},
        "large job": _large_job(folder),
    }


def _write_shots(options: argparse.Namespace, folder: Path) -> None:
    """Write motions and their job."""
    skeleton = read_character(demo_body_path()).skeleton
    whole = demo_shot(skeleton)
    model, stage = (shutil.copy(shipped_path("cape"), folder), shutil.copy(demo_body_path(), folder / "body.usdc"))
    requests = []
    for shot in range(options.shots):
        start = shot % (whole.frame_count - options.frames)
        path = folder / f"shot_{shot:03d}.usdc"
        write_motion(path, replace(whole.clip(start, start + options.frames), start=0.0), skeleton)
        requests.append(BakeRequest(model=str(model), stage=str(stage), motion=str(path)))
    write_job(folder / "job.json", submitted(plan_layers(requests), silent))


def _run(commands: Sequence[Sequence[str]], folder: Path, delay: float) -> dict[str, Any]:
    """Run commands at the same time; return how long they took, and what they asked of the disk."""
    workers = [Worker(words, folder, folder / f"strace_{number}.log", delay) for number, words in enumerate(commands)]
    before, began = os.times(), time.perf_counter()
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.wait()
    seconds, after = time.perf_counter() - began, os.times()
    counts = [worker.counts() for worker in workers]
    return {
        "seconds": round(seconds, 1),
        "operations in the folder": sum(own for own, _ in counts),
        "operations": sum(every for _, every in counts),
        "operations of the busiest worker": max(every for _, every in counts),
        "seconds of computing, start included": round(sum(after[2:4]) - sum(before[2:4]), 1),
    }


def _large_job(folder: Path) -> dict[str, Any]:
    """Write a job of five garments in many shots, with paths of usual length; return its size, and how it is read."""
    shots = [f"s{shot // 100:03d}_{shot:05d}" for shot in range(JOB_TASKS // 5)]
    paths = {shot: f"/shows/example/sequences/{shot[:4]}/{shot}/animation/publish/hero.usdc" for shot in shots}
    request = BakeRequest(model="/shows/example/assets/cape.safetensors", stage="/shows/example/hero.usd", motion="")
    inputs = {path: InputContents(((path, 64 * "0"),)) for path in (request.model, request.stage, *paths.values())}
    tasks = [BakeTask(garment=f"cape_{number}", shot=shot, request=replace(request, motion=path))
             for number in range(5) for shot, path in paths.items()]  # fmt: skip
    write_job(folder / "large.json", FarmJob(tuple(tasks), inputs))
    began = time.process_time()
    read_job(folder / "large.json", chosen="0-9")
    seconds = time.process_time() - began
    return {"tasks": JOB_TASKS, "bytes": (folder / "large.json").stat().st_size, "seconds to read ten": seconds}


if __name__ == "__main__":
    main()
