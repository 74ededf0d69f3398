# SPDX-License-Identifier: Apache-2.0
"""Time a training step and each of its parts, beside the reference implementations in PyTorch and the floor, and how
that grows.

    python benchmarks/training.py --device cuda

The scene is synthetic, so that every size is exact. The first of each list of sizes is the base case, around which
one size at a time is changed; the batch that training has by default is a case of its own. On a GPU each part is a
CUDA graph of its own, timed with cold caches; the reference implementation of the nearest body point, and with it the
plain step, cannot be captured and are launched as they are. Each time is a median over repeats. A floor is the larger
of bytes over the rate of a copy and operations over the rate of a float32 matrix product, both measured in the same
run (helpers/floors.py); that of the nearest body point counts brute force.
"""

from __future__ import annotations

import argparse
import gc
import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, replace
from importlib.metadata import version
from typing import Any
from unittest import mock

import torch
from helpers.clock import Clock, Rates, Span, Work, side_stream
from helpers.floors import WARM, WINDOWS, Floor
from helpers.moment import Moment
from helpers.parts import all_parts
from helpers.peak import Peak
from helpers.reports import save_results, write_results
from helpers.synthetic import Size, stepper
from helpers.training_tables import tables

from ssilk_core.devices import select_device
from ssilk_core.physics import kernels
from ssilk_core.training.settings import TrainConfig
from ssilk_core.training.step import Stepper

SIZES = {
    "vertices": (2500, 1250, 5000, 10000),
    "body": (587, 1229, 4000),
    "proxies": (20, 10, 40),
    "shapes": (64, 16, 256),
    "window": (32, 16, 64),
    "batch": (32, 16, 64),
    "static_batch": (64,),
}
REFERENCE, KERNELS = "reference", "kernels"

Figures = dict[str, Any]


def cases(options: argparse.Namespace) -> dict[str, Size]:
    """Return the base case and those that differ from it in one size, by name."""
    base = Size(**{name: getattr(options, name)[0] for name in SIZES})
    others = [{name: count} for name in SIZES for count in getattr(options, name)[1:]]
    if options.default_batch:
        others.append({name: getattr(TrainConfig(), name) for name in ("batch", "window", "static_batch")})
    named = {", ".join(f"{name} {count}" for name, count in other.items()): other for other in others}
    return {"base": base, **{name: replace(base, **other) for name, other in named.items()}}


@contextmanager
def variant(name: str) -> Iterator[None]:
    """Let everything be built and run with the reference implementations, or as it is."""
    if name == KERNELS:
        yield
        return
    with mock.patch.object(kernels, "available", lambda device: False):
        yield


def measure(size: Size, name: str, clock: Clock, device: torch.device) -> Figures:
    """Return times of whole steps and parts, the floor of each part and a GPU's peak memory [bytes]."""
    with variant(name):
        gc.collect()  # or what the last case left would count
        peak = Peak(device)
        steps = stepper(size, device)
        whole = {phase: asdict(whole_step(steps, phase, name == KERNELS, clock)) for phase in (WARM, WINDOWS)}
        held = peak.bytes() if clock.on_gpu else None  # a processor's memory is not given back in between
        return {"steps": whole, "peak": held, "parts": measure_parts(Moment(steps), clock)}


def whole_step(steps: Stepper, phase: str, captured: bool, clock: Clock) -> Span:
    """Time whole steps of a phase, one after the other."""
    iteration = 0 if phase == WARM else steps.config.static_iterations
    if clock.on_gpu and not captured:
        return clock.calls(steps.static_step if phase == WARM else steps.dynamic_step)
    for _ in range(5):
        steps.run(iteration)  # settles and captures
    return clock.calls(lambda: steps.run(iteration))


def measure_parts(at: Moment, clock: Clock) -> dict[str, Figures]:
    """Return times, floors and phases of all parts, alone and with their backward passes."""
    measured = {}
    for part in all_parts(at):
        alone, both = part.floors()
        runs: list[tuple[str, Work, Floor, tuple[str, ...]]]
        runs = [(part.name, part.run, alone, () if part.leaves else part.phases)]
        if part.leaves:
            runs.append((f"{part.name}, with backward", part.with_backward(), both, part.phases))
        for name, run, floor, phases in runs:
            span = clock.work(run, captured=part.captured, generator=at.sampler.generator)
            measured[name] = {**asdict(span), "floor": asdict(floor), "phases": phases}
    return measured


def measure_case(size: Size, variants: list[str], device: torch.device, options: argparse.Namespace) -> Figures:
    """Return what `measure` does of each variant, and the rates of the device."""
    torch.set_num_threads(options.threads)
    with torch.cuda.stream(side_stream(device)):
        clock = Clock(device, options.seconds)
        rates = asdict(Rates.measured(clock, device))
        return {"rates": rates, **{variant: measure(size, variant, clock, device) for variant in variants}}


def measure_all(options: argparse.Namespace) -> Figures:
    """Measure every case in every variant that the device has, and write what is known after each.

    Each case has a process of its own, so that nothing of one is left when the next begins.
    """
    device = select_device(options.device)
    variants = [REFERENCE, KERNELS] if kernels.available(device) else [REFERENCE]
    measured: Figures = {"triton": version("triton") if KERNELS in variants else None, "cases": {}}
    spawned = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawned, max_tasks_per_child=1) as processes:
        for name, size in cases(options).items():
            case = processes.submit(measure_case, size, variants, device, options).result()
            rates = case.pop("rates")
            measured.setdefault("rates", rates)
            measured["cases"][name] = {"size": asdict(size), **case}
            steps = (f"{kind} {figures['steps'][WINDOWS]['median']:.3g} ms" for kind, figures in case.items())
            print(f"{name}: a step {', '.join(steps)}", flush=True)
            save_results(options, kept(measured))
    return measured


def kept(measured: Figures) -> Figures:
    """Return medians of steps and memory in each case, and medians of the parts of the base case."""
    cases = {
        name: {
            variant: {
                "steps [ms]": {phase: span["median"] for phase, span in of["steps"].items()},
                "peak [bytes]": of["peak"],
            } if variant != "size" else of
            for variant, of in case.items()
        }
        for name, case in measured["cases"].items()
    }  # fmt: skip
    base = {variant: of["parts"] for variant, of in measured["cases"]["base"].items() if variant != "size"}
    parts = {
        name: {f"{variant} [ms]": of[name]["median"] for variant, of in base.items()} for name in base[REFERENCE]
    }
    return {"triton": measured["triton"], "cases": cases, "parts of the base case": parts}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", help="'cpu' or 'cuda' (default cpu)")
    parser.add_argument("--threads", type=int, default=2, help="processor threads (default 2)")
    parser.add_argument("--seconds", type=float, default=0.02, help="to repeat each part for, about (default 0.02)")
    parser.add_argument("--name", default="training", help="of the result files (default training)")
    for name, counts in SIZES.items():
        parser.add_argument(f"--{name}", type=int, nargs="+", default=counts, help=f"(default {counts})")
    parser.add_argument("--no-default-batch", dest="default_batch", action="store_false",
                        help="leave out the batch that training has by default")  # fmt: skip
    options = parser.parse_args()
    measured = measure_all(options)
    write_results(options, tables(measured), kept(measured))


if __name__ == "__main__":
    main()
