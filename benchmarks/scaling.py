# SPDX-License-Identifier: Apache-2.0
"""Time training steps of one garment in one process and in several that share the batch, one on each GPU.

    python benchmarks/scaling.py cape_stage.usdc --motions train --valid valid

Options that are not of this script are those of 'ssilk train' and say what is trained. A step is what that command
does, whole: on GPUs a CUDA graph with the exchange of gradients in it. A batch of 64 is timed in one process, in
several, and as "64/2": what each of two has to do, in one process by itself, which is what an exchange without any
cost would reach. All is measured in each round anew, by new processes, so that the spread holds what differs between
starts. The time of a block of steps is that of the slowest process.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from helpers.reports import table, write_results

from ssilk_core.cli.main import parser as ssilk_parser
from ssilk_core.cli.train import training_job
from ssilk_core.devices import device_name, select_device
from ssilk_core.events import silent
from ssilk_core.training.divergence import CHECK_INTERVAL
from ssilk_core.training.parallel import ProcessGroup, join_process_group
from ssilk_core.training.run import TrainingRun

SETTLE = 8  # steps before any is timed: eager ones, the capture, and some more
HEADER = ("step", "processes", "batch", "ms", "10 % - 90 %", "iterations/s", "speed-up", "exchange [ms]", "alike")

Figures = dict[str, Any]


# --- in the processes that train ----------------------------------------------------------------------------------


def measure(options: argparse.Namespace, batch: str, group: ProcessGroup, device: str) -> Figures:
    """Return times of both kinds of step of "batch" or "batch/parts" [s], and whether parameters are alike."""
    whole, _, parts = batch.partition("/")
    with tempfile.TemporaryDirectory() as folder:
        words = ["train", *options.training, "--set", f"batch={whole}", "-o", f"{folder}/model.safetensors"]
        job = training_job(ssilk_parser().parse_args(words), device, silent)
        run = TrainingRun(replace(job, train=ProcessGroup(0, int(parts or 1)).local_config(job.train)), silent, group)
    phases = {"warm start": 0, "windows": run.config.static_iterations}
    times = {name: blocks(run, iteration, group, options) for name, iteration in phases.items()}
    parameters = b"".join(value.detach().cpu().numpy().tobytes() for value in run.stepper.model.parameters())
    alike = len(set(group.gather(hashlib.sha256(parameters).hexdigest()))) == 1
    return {"times": times, "exchange": exchange(run, group, options), "alike": alike}


def blocks(run: TrainingRun, iteration: int, group: ProcessGroup, options: argparse.Namespace) -> list[float]:
    """Return the time of a step in each of several blocks of steps [s]."""
    for _ in range(SETTLE):
        run.stepper.run(iteration)

    def steps() -> None:
        for number in range(options.steps):
            run.stepper.run(iteration)
            if number % CHECK_INTERVAL == 0:
                group.any(False)  # as training does

    return [timed(steps, run, group) / options.steps for _ in range(options.blocks)]


def exchange(run: TrainingRun, group: ProcessGroup, options: argparse.Namespace) -> float:
    """Return the time that averaging the gradients takes by itself, launched as it is [s]."""
    if group.size == 1:
        return 0.0
    tensors = [torch.zeros_like(value) for value in run.stepper.model.parameters()]

    def average() -> None:
        for _ in range(options.steps):
            group.average(tensors)

    return min(timed(average, run, group) for _ in range(3)) / options.steps


def timed(work: Any, run: TrainingRun, group: ProcessGroup) -> float:
    """Return how long the slowest process takes, all beginning together [s]."""
    settle(run.device)
    group.gather(None)
    began = time.perf_counter()
    work()
    settle(run.device)
    return max(group.gather(time.perf_counter() - began))


def settle(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def work_in_team(options: argparse.Namespace) -> None:
    """Measure the batches that this process was started for; the first of the group writes what was found."""
    with join_process_group(options.device) as (group, device):
        found = {batch: measure(options, batch, group, device) for batch in options.only}
        if group.is_first:
            options.into.write_text(json.dumps(found))


# --- in the process that compares ---------------------------------------------------------------------------------


@dataclass
class ScalingCase:
    """One kind of step at one batch: times [s], those of the exchange by itself, whether parameters stayed alike."""

    step: str
    processes: int
    batch: str
    times: list[float] = field(default_factory=list)
    exchanges: list[float] = field(default_factory=list)
    alike: bool = True


def launched(processes: int, batches: list[str]) -> dict[str, Figures]:
    """Measure batches with so many processes, started as 'torchrun' starts them."""
    launcher = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(processes)]
    with tempfile.TemporaryDirectory() as folder:
        into = Path(folder) / "found.json"
        words = [__file__, *sys.argv[1:], "--into", str(into), "--only", *batches]
        subprocess.run([sys.executable, *(launcher if processes > 1 else []), *words], check=True)
        return json.loads(into.read_text())


def plan(options: argparse.Namespace) -> dict[int, list[str]]:
    """Return what to measure with each number of processes."""
    found: dict[int, list[str]] = {1: []}
    for case in options.cases:
        processes, _, batch = case.partition("x")
        found.setdefault(int(processes), []).append(batch)
        found[1] += [batch, f"{batch}/{processes}"]
    return {processes: [*dict.fromkeys(batches)] for processes, batches in sorted(found.items())}


def measure_all(options: argparse.Namespace) -> list[ScalingCase]:
    """Return all cases, with what was found in all rounds."""
    measured: dict[tuple[str, int, str], ScalingCase] = {}
    for number in range(options.rounds):
        for processes, batches in plan(options).items():
            for batch, found in launched(processes, batches).items():
                print(f"round {number + 1}, processes {processes}, batch {batch}: {found}", flush=True)
                for step, times in found["times"].items():
                    case = measured.setdefault((step, processes, batch), ScalingCase(step, processes, batch))
                    case.times += times
                    case.exchanges.append(found["exchange"])
                    case.alike &= found["alike"]
    return sorted(measured.values(), key=lambda case: case.step)


def rows(measured: list[ScalingCase]) -> Iterator[list[object]]:
    """Yield a line of the table for each case; speed-ups are over one process with the whole batch."""
    medians = {(case.step, case.processes, case.batch): np.median(case.times) for case in measured}
    for case in measured:
        low, median, high = 1000 * np.percentile(case.times, (10, 50, 90))
        faster = 1000 * medians[case.step, 1, case.batch.partition("/")[0]] / median
        several = [f"{1000 * min(case.exchanges):.3g}", "yes" if case.alike else "NO"]
        yield [case.step, case.processes, case.batch, f"{median:.3g}", f"{low:.3g} - {high:.3g}",
               f"{1000 / median:.4g}", f"{faster:.2f}", *(several if case.processes > 1 else ["", ""])]  # fmt: skip


def default_cases(device: str) -> list[str]:
    """Return "processes x batch" for the GPUs that there are."""
    count = torch.cuda.device_count() if device != "cpu" else 2
    return [case for case, needed in (("2x64", 2), ("2x128", 4), ("4x128", 4)) if needed <= count]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False
    )
    parser.add_argument("--device", default="auto", help="'auto', 'cpu' or 'cuda' (default auto)")
    parser.add_argument("--threads", type=int, default=2, help="processor threads of each process (default 2)")
    parser.add_argument(
        "--cases", nargs="+", metavar="PROCESSESxBATCH", help="(default 2x64, with four GPUs 4x128 too)"
    )
    parser.add_argument("--rounds", type=int, default=2, help="times that all is measured anew (default 2)")
    parser.add_argument("--blocks", type=int, default=10, help="blocks of steps in each round (default 10)")
    parser.add_argument("--steps", type=int, default=50, help="steps in a block (default 50)")
    parser.add_argument("--name", default="scaling", help="of the result files (default scaling)")
    parser.add_argument("--only", nargs="+", help=argparse.SUPPRESS)
    parser.add_argument("--into", type=Path, help=argparse.SUPPRESS)
    options, training = parser.parse_known_args()
    options.training = training
    torch.set_num_threads(options.threads)
    if options.only:
        work_in_team(options)
        return
    options.cases = options.cases or default_cases(options.device)
    measured = measure_all(options)
    device = select_device(options.device)
    count = torch.cuda.device_count() if device.type == "cuda" else 1
    options.hardware = f"{count} x {device_name(device)}, {options.threads} threads for each process"
    write_results(options, table(HEADER, [*rows(measured)]), {"cases": [*map(asdict, measured)]})


if __name__ == "__main__":
    main()
