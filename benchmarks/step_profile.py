# SPDX-License-Identifier: Apache-2.0
"""Where a training step of a garment that ships spends its time on a GPU.

    python benchmarks/step_profile.py --garment cape --stage demo_body.usdc --motions FOLDER --index FILE

The training goes on from the model that ships, with its settings, but no extra motions, which cost setup and no step.
Steps are captured graphs. Their time is that of many; then a few are traced, whose kernels are told by name.
"""

from __future__ import annotations

import argparse
import re
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from helpers.reports import provenance, table
from ssilk_usd.opening.stage import open_stage
from ssilk_usd.reading.motion import read_motion
from torch.autograd import DeviceType
from torch.profiler import ProfilerActivity, profile

from ssilk_core.delivery.bake import worn
from ssilk_core.demo.shipped import shipped_path
from ssilk_core.events import TextReporter
from ssilk_core.network.checkpoint import load_model
from ssilk_core.quality.evaluation.splits import chosen, read_index
from ssilk_core.training.job import TrainJob
from ssilk_core.training.run import TrainingRun
from ssilk_core.training.settings import TrainConfig

WARM, REPEATS, STEPS, TRACED = 10, 3, 100, 3
LEAST = 0.05  # [ms] that a row has
KINDS = {"matrix products": "gemm|cutlass|nvjet|splitK", "copies, sums and other products": "."}


def job_of(options: argparse.Namespace, output: Path) -> TrainJob:
    """Return the training that goes on from a garment that ships."""
    file = load_model(shipped_path(options.garment))
    on, index = worn(file, open_stage(options.stage), None), read_index(options.index)
    settings = replace(TrainConfig(**file.provenance["train"]), recombinations=0, perturbations=0)

    def motions(split: str) -> list:
        skeleton = on.scene.character.skeleton
        return [read_motion(options.motions / f"{name}.usdc", skeleton) for name in chosen(index, split)]

    base = replace(file, scene=replace(on.scene, character=on.file.scene.character))
    return TrainJob(
        scene=on.scene, motions=motions("train"), held_out=motions("valid")[:1], model=file.config, train=settings,
        fabric=file.fabric, output=output, device=options.device, base=base, whole=True,
    )  # fmt: skip


def milliseconds(run: TrainingRun, steps: int) -> float:
    """Return the time of a step."""
    torch.cuda.synchronize()
    began = time.perf_counter()
    for _ in range(steps):
        run.step()
    torch.cuda.synchronize()
    return 1e3 * (time.perf_counter() - began) / steps


def traced(run: TrainingRun) -> tuple[dict[str, float], float]:
    """Run a few steps; return the milliseconds of a step that each kernel takes, and how many a step launches."""
    with profile(activities=[ProfilerActivity.CUDA]) as trace:
        milliseconds(run, TRACED)
    found: dict[str, float] = {}
    kernels = [event for event in trace.events() if event.device_type == DeviceType.CUDA]  # else calls
    for event in kernels:
        found[event.name] = found.get(event.name, 0.0) + event.time_range.elapsed_us() / 1e3 / TRACED
    return found, len(kernels) / TRACED


def kind_of(kernel: str) -> str:
    """Return the name of one of this project's kernels, or what kind of PyTorch's a kernel is."""
    if re.fullmatch(r"_\w+", kernel):
        return kernel
    return next(kind for kind, pattern in KINDS.items() if re.search(pattern, kernel))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--garment", default="cape")
    parser.add_argument("--stage", type=Path, required=True)
    parser.add_argument("--motions", type=Path, required=True, metavar="FOLDER")
    parser.add_argument("--index", type=Path, required=True, help="JSON list of clips and their splits")
    parser.add_argument("--threads", type=int, default=1, help="processor threads (default 1)")
    parser.set_defaults(device="cuda")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    began = time.perf_counter()
    with TemporaryDirectory() as folder:
        run = TrainingRun(job_of(options, Path(folder) / "model.safetensors"), TextReporter())
        milliseconds(run, WARM)
        setup = time.perf_counter() - began
        times = sorted(milliseconds(run, STEPS) for _ in range(REPEATS))
        kernels, launches = traced(run)
    shares: dict[str, float] = {}
    for name, each in kernels.items():
        shares[kind_of(name)] = shares.get(kind_of(name), 0.0) + each
    print("\n".join(f"{name}: {value}" for name, value in provenance(options).items()))
    print(f"first steps after {setup:.0f} s; a step {times[0]:.2f} to {times[-1]:.2f} ms, {launches:.0f} launches")
    rows = sorted(shares.items(), key=lambda row: -row[1])
    print(table(["kernel", "ms"], [[name, f"{value:.2f}"] for name, value in rows if value >= LEAST]))


if __name__ == "__main__":
    main()
