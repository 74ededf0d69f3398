# SPDX-License-Identifier: Apache-2.0
"""Bake tasks of a job that 'ssilk farm' wrote, or check that all are done: what a farm's workers run.

Tasks that are done are left alone. A task with bad input fails alone: the others are baked, and the exit code is 4.
With --openjd it is 0 then, because a session that runs here begins nothing after a step that failed; the last step of
the job, --check, fails instead.
--check writes the stage of each shot, and its exit code is 3 unless every task is done and every file as written.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from ..delivery.farm.job import read_job
from ..delivery.farm.openjd import OpenJdReporter
from ..delivery.farm.work import bake_tasks, check_tasks
from ..errors import EXIT_OK, EXIT_TASKS
from ..events import Reporter


def add_arguments(verb: argparse.ArgumentParser) -> None:
    """Add the options of this verb."""
    verb.add_argument("job", type=Path, help="job.json of a bundle written by 'ssilk farm'")
    verb.add_argument("-o", "--output", type=Path, required=True, help="folder of the layers")
    verb.add_argument("--tasks", metavar="0-9,12", help="numbers of the tasks to bake (default: all)")
    verb.add_argument("--check", action="store_true", help="bake nothing; check that everything is done")
    verb.add_argument("--path-mapping", type=Path, metavar="FILE",
                      help="Open Job Description's rules for where the inputs lie on this machine")  # fmt: skip
    verb.add_argument("--openjd", action="store_true", help="progress and status as Open Job Description's sessions "
                      "read it, on standard output")  # fmt: skip


def run(options: argparse.Namespace, report: Reporter) -> int:
    """Bake or check."""
    report = OpenJdReporter() if options.openjd else report
    if options.check:
        check_tasks(read_job(options.job, options.path_mapping), options.output, report)
        return EXIT_OK
    failed = bake_tasks(read_job(options.job, options.path_mapping, options.tasks).tasks, options.output, report)
    return EXIT_TASKS if failed and not options.openjd else EXIT_OK
