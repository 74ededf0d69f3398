# SPDX-License-Identifier: Apache-2.0
"""Bake many shots on a farm: write a bundle of Open Job Description, or run its tasks on a Ray cluster.

The bundle runs unchanged with 'openjd run' on one machine and with 'deadline bundle submit' on Deadline Cloud. Each
task is one garment in one shot, on one body; with --refine or --certify outer garments come after those that they
were trained over, and are refined and certified over these. Running a job again, anywhere, leaves finished tasks
alone. With --device cuda each host needs a GPU. Both commands take the size of chunks as the job's parameters:
-p ChunkSize=20 -p ChunkSeconds=600.
"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ..delivery.bake import BakeTask, LayerFolder, plan_layers
from ..delivery.bake.layered import in_levels, put_over, tell_layers
from ..delivery.farm.job import NAME, FarmJob, is_job, submitted
from ..delivery.farm.openjd import TEMPLATE, BundleOptions, write_bundle
from ..errors import EXIT_OK, EXIT_TASKS, fail
from ..events import Countdown, Failed, GarmentEvent, Message, Reporter, Result, Started
from .options.bake import add_bake
from .options.numbers import NumberRange
from .options.requests import layer_options, requests_of

if TYPE_CHECKING:
    from ..delivery.farm.cluster import TaskOutcome


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    add_bake(verb)
    verb.add_argument("-o", "--output", type=Path, help="folder of the layers (default: 'layers' in the bundle)")
    where = verb.add_mutually_exclusive_group(required=True)
    where.add_argument("--bundle", type=Path, metavar="FOLDER", help="folder of the job bundle to write")
    where.add_argument("--cluster", nargs="?", const="", metavar="ADDRESS",
                       help="run now on a Ray cluster (default: all cores of this machine)")  # fmt: skip
    group = verb.add_argument_group("job bundle")
    defaults = BundleOptions()
    group.add_argument(
        "--memory",
        type=NumberRange(1, 2**31 - 1, int),
        default=defaults.memory,
        metavar="MIB",
        help="that a host needs (default %(default)s)",
    )
    group.add_argument("--timeout", type=NumberRange(1, 2**31 - 1, int), default=defaults.timeout, metavar="SECONDS",
                       help="after which a chunk of shots is cancelled (default %(default)s)")  # fmt: skip


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Write the bundle, or run the tasks."""
    if not (options.bundle or options.output):
        fail("--cluster", "no folder for the layers", "-o names one")
    tasks = [_absolute(task) for task in plan_layers(requests_of(options), **layer_options(options))]
    if any(task.request.meets_beneath for task in tasks):
        tasks = put_over(tasks, report)
    if options.output:
        LayerFolder(options.output).need_names(tasks, complete=not options.bundle)
    job = submitted(tasks, report)
    if options.bundle:
        return _write(job, options, report)
    return _run(job.tasks, options, report)


def _absolute(task: BakeTask) -> BakeTask:
    """Return a task whose inputs have absolute paths: workers start elsewhere."""
    return replace(task, request=task.request.relocated(lambda path: str(Path(path).absolute())))


def _write(job: FarmJob, options: argparse.Namespace, report: Reporter) -> int:
    fixed, place = BundleOptions(memory=options.memory, timeout=options.timeout), options.bundle / NAME
    before = place.read_bytes() if is_job(place) else b""
    write_bundle(options.bundle, job, options.output, fixed)
    if before and before != place.read_bytes():
        report(Message(f"{place}: the job that was there is replaced by this one", "warning"))
    output = ["-p", f"Output={options.output.absolute()}"] if options.output else []
    detail = {
        "bundle": str(options.bundle),
        "tasks": len(job.tasks),
        "on this machine": shlex.join(["openjd", "run", str(options.bundle / TEMPLATE), *output]),
        "on Deadline Cloud": shlex.join(["deadline", "bundle", "submit", str(options.bundle)]),
    }
    report(Result("farm", detail))
    return EXIT_OK


def _run(tasks: Sequence[BakeTask], options: argparse.Namespace, report: Reporter) -> int:
    from ..delivery.farm.cluster import bake_here, run_on_cluster

    report(Started("farm", len(tasks), {"output": str(options.output)}))
    ended: list[TaskOutcome] = []
    told = Countdown(len(tasks), report)
    for level in in_levels(tasks):
        for outcome in run_on_cluster(level, options.output, bake_here, address=options.cluster or None):
            ended.append(outcome)
            if outcome.error:
                report(GarmentEvent(outcome.task.name, Failed(outcome.error)))
            told()
    layers = LayerFolder(options.output)
    layers.remove_unfinished(tasks)
    layers.write_stages([outcome.task for outcome in ended if outcome.result], report)
    fresh = (outcome.task.shot for outcome in ended if outcome.result and not outcome.result.current)
    for shot in dict.fromkeys(fresh):
        tell_layers(layers.path, shot, report)
    results = [outcome.result for outcome in ended if outcome.result]
    current, failed = sum(result.current for result in results), len(ended) - len(results)
    report(Result("farm", {"baked": len(results) - current, "current": current, "failed": failed}))
    return EXIT_TASKS if failed else EXIT_OK
