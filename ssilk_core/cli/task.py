# SPDX-License-Identifier: Apache-2.0
"""Bake some tasks of a job that 'ssilk farm' wrote, or check that all are done; this is what a farm's workers run.

What is done already is left alone. A task with bad input fails alone: the others are baked, and the exit code is 4.
--check writes the stage of each shot, and its exit code is 3 unless every task is done and every file as written.
"""

from __future__ import annotations

import argparse
import signal
from collections.abc import Sequence
from pathlib import Path

from ..errors import EXIT_OK, EXIT_TASKS, SsilkError, VerificationError
from ..events import Event, Failed, GarmentEvent, Message, Progress, Reporter, Result, Started
from ..farm.job import numbers, read_job
from ..farm.openjd import OpenJdReporter
from ..farm.tasks import BakeTask


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    verb.add_argument("job", type=Path, help="job.json of a bundle written by 'ssilk farm'")
    verb.add_argument("-o", "--output", type=Path, required=True, help="folder of the layers")
    verb.add_argument("--tasks", metavar="0-9,12", help="numbers of the tasks to bake (default: all)")
    verb.add_argument("--check", action="store_true", help="bake nothing; check that everything is done")
    verb.add_argument("--again", action="store_true", help="bake what is current, too")
    verb.add_argument("--path-mapping", type=Path, metavar="FILE",
                      help="Open Job Description's rules for where the inputs lie on this machine")  # fmt: skip
    verb.add_argument("--openjd", action="store_true", help="progress and status as Open Job Description's sessions "
                      "read it, on standard output")  # fmt: skip


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Bake or check."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # farms cancel by it: stop as on Ctrl-C
    report = OpenJdReporter() if options.openjd else report
    tasks = read_job(options.job, options.path_mapping)
    if options.check:
        return _check(tasks, options.output, report)
    chosen = [tasks[number] for number in numbers(options.tasks or f"0-{len(tasks) - 1}", len(tasks))]
    return _bake(chosen, options, report)


def _bake(tasks: Sequence[BakeTask], options: argparse.Namespace, report: Reporter) -> int:
    from ._layers import Wardrobe, bake_task

    wardrobe, failed = Wardrobe(), 0
    for index, task in enumerate(tasks):
        report(GarmentEvent(task.name, Started("bake", 1)))
        part = _part(report, index, len(tasks))
        try:
            report(
                GarmentEvent(
                    task.name, Result("bake", bake_task(task, options.output, wardrobe, part, again=options.again))
                )
            )
        except SsilkError as error:
            failed += 1
            report(GarmentEvent(task.name, Failed(str(error))))
        report(Progress(index + 1, len(tasks)))
    return EXIT_TASKS if failed else EXIT_OK


def _part(report: Reporter, index: int, count: int) -> Reporter:
    """Return a reporter for one of several tasks, whose progress is a part of the whole."""

    def part(event: Event) -> None:
        if isinstance(event, Progress):
            report(Progress(index * event.total + event.done, count * event.total))
        else:
            report(event)

    return part


def _check(tasks: Sequence[BakeTask], output: Path, report: Reporter) -> int:
    """Write the stages of the shots and raise `VerificationError` unless everything is there."""
    from ._layers import clear, write_stages

    clear(tasks, output)
    done = [task for task in tasks if _is_done(task, output, report)]
    write_stages(done, output, report)
    missing = [task.name for task in set(tasks).difference(done)]
    if missing:
        raise VerificationError(
            f"{output}: {len(missing)} of {len(tasks)} tasks are not done, or their files are not as they were "
            f"written ({', '.join(sorted(missing)[:5])}); run them again."
        )
    report(Result("check", {"tasks": len(tasks), "output": str(output)}))
    return EXIT_OK


def _is_done(task: BakeTask, output: Path, report: Reporter) -> bool:
    from ._layers import is_done

    try:
        return is_done(task, output)
    except SsilkError as error:  # an input that cannot be read
        report(Message(f"{task.name}: {error}", "warning"))
        return False
