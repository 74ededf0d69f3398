# SPDX-License-Identifier: Apache-2.0
"""Train and measure all that the paper's tables and figures need, as a queue of processes on several GPUs.

    python benchmarks/paper.py OUT --stages STAGES --motions FOLDER --index FOLDER/index.json --gpus 4 --until 570
    python benchmarks/tables.py table1 OUT/records
    python benchmarks/tables.py ablations OUT/sweeps

STAGES holds the rigged garments of `paper_jobs.GARMENTS`, and the cape with other numbers of proxies. A job is done
when its outputs exist, so the same command again continues with what is missing. No job begins that is predicted to
end after --until. --list shows all jobs and runs none. Trainings on one GPU overlap, which hides their start. Each
has as many steps as take --seconds on a GPU of its own, whatever its method.
"""

from __future__ import annotations

import argparse
import os
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from helpers.paper_jobs import GARMENTS, PYTHON, TABLES, Job, Plan, jobs, without_models
from helpers.reports import table

from ssilk_core.errors import EXIT_OK, EXIT_WORSE, SsilkError
from ssilk_core.events import TextReporter
from ssilk_core.training.signals import stop_on_signals
from ssilk_core.training.wardrobe.queue import CommandTask, End, Queue

ROOT = Path(__file__).parent.parent
PATHS = (ROOT, ROOT / "usd", ROOT / "benchmarks")


@dataclass
class Backlog:
    """Jobs by priority; each can begin once what it needs has ended, well or not.

    Attributes:
        left: jobs that have not begun; running: those that have, by name.
        until: no job begins that would end later than this [s], as predicted.
        failed: names of jobs that left an output out or ended with an error.
    """

    left: list[Job]
    folder: Path
    until: float
    running: dict[str, Job] = field(default_factory=dict)
    failed: list[str] = field(default_factory=list)
    began: float = field(default_factory=time.monotonic)

    @property
    def elapsed(self) -> float:
        return time.monotonic() - self.began

    def take(self) -> CommandTask | None:
        """Return the next job that can begin now and end in time, as a task; None where there is none."""
        pending = {path for job in (*self.left, *self.running.values()) for path in job.outputs}
        for job in self.left:
            if not pending & set(job.needs) and self.elapsed + job.seconds <= self.until:
                self.left.remove(job)
                self.running[job.name] = job
                return self._task(without_models(job))
        return None

    def _task(self, job: Job) -> CommandTask:
        words = [sys.executable if word == PYTHON else word for word in job.command]
        log = self._log(job)
        log.parent.mkdir(parents=True, exist_ok=True)
        log.unlink(missing_ok=True)
        for output in job.outputs:
            output.parent.mkdir(parents=True, exist_ok=True)
        return CommandTask(job.name, words, ROOT, log)

    def _log(self, job: Job) -> Path:
        return self.folder / "logs" / f"{job.name}.log"

    def ended(self, name: str, end: End) -> None:
        """Say how a job ended."""
        job = self.running.pop(name)
        told = f"{end.seconds:.0f} s (predicted {job.seconds:.0f})"
        if end.code not in (EXIT_OK, EXIT_WORSE) or not job.is_done:
            self.failed.append(name)
            last = (self._log(job).read_text().strip().splitlines() or ["no output"])[-1]
            told = f"FAILED with code {end.code} after {told}: {last}"
        print(f"[{self.elapsed:5.0f} s] {name}: {told}", flush=True)


def run(backlog: Backlog, gpus: Sequence[int | None], stop: threading.Event) -> None:
    """Run what can be run, one job at a time for each entry of `gpus`; None stands for the processor."""
    paths = os.pathsep.join([*map(str, PATHS), *filter(None, [os.environ.get("PYTHONPATH")])])
    slots = [{"PYTHONPATH": paths, **({} if gpu is None else {"CUDA_VISIBLE_DEVICES": str(gpu)})} for gpu in gpus]
    Queue(slots, lambda name, event: None, backlog.ended).run(backlog.take, stop)


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, metavar="OUT", help="where models, shots, records and logs go")
    parser.add_argument("--stages", type=Path, required=True, help="folder of rigged stages")
    parser.add_argument("--motions", type=Path, required=True, metavar="FOLDER", help="folder of motion files")
    parser.add_argument("--index", type=Path, required=True, help="JSON list of clips with their splits and tags")
    parser.add_argument("--tables", nargs="+", choices=TABLES, default=TABLES, help="only what these need")
    parser.add_argument("--garments", nargs="+", choices=GARMENTS, default=GARMENTS, help="only these in Table 1")
    parser.add_argument(
        "--gpus", type=int, default=1, help="how many GPUs there are, 0 for the processor (default 1)"
    )
    parser.add_argument("--per-gpu", type=int, default=2, help="jobs side by side on each (default 2)")
    parser.add_argument(
        "--seconds", type=float, default=60.0, help="of steps, for Table 1 and its seeds (default 60)"
    )
    parser.add_argument("--sweep-seconds", type=float, default=45.0, help="of steps, for the sweeps (default 45)")
    parser.add_argument("--frames", type=int, default=64, help="of a simulated sequence (default 64)")
    parser.add_argument("--batch", type=int, default=96, help="sequences simulated together (default 96)")
    parser.add_argument("--iterations", type=int, default=50, help="of the solver in each frame (default 50)")
    parser.add_argument("--clips", nargs="+", default=(), metavar="NAME", help="only these held-out clips")
    parser.add_argument("--until", type=float, default=3600.0, metavar="S", help="begin nothing that ends later")
    parser.add_argument("--list", action="store_true", help="list the jobs with predicted times, and run none")
    parser.add_argument("--rehearse", action="store_true", help="four small steps each, two clips: whether all runs")
    return parser.parse_args()


def planned(options: argparse.Namespace) -> Plan:
    """Return what the options ask for, with paths that hold in any working directory."""
    return Plan(
        folder=options.folder.resolve(),
        stages=options.stages.resolve(),
        motions=options.motions.resolve(),
        index=options.index.resolve(),
        device="cuda" if options.gpus else "cpu",
        garments=options.garments,
        tables=options.tables,
        seconds=options.seconds,
        sweep_seconds=options.sweep_seconds,
        frames=options.frames,
        batch=options.batch,
        iterations=options.iterations,
        clips=options.clips,
        rehearse=options.rehearse,
    )


def listed(found: Sequence[Job], workers: int) -> str:
    """Return the jobs as a table, with what they take together."""
    rows = [(job.name, f"{job.seconds:.0f}", "done" if job.is_done else "") for job in found]
    left = sum(job.seconds for job in found if not job.is_done)
    return (
        table(("job", "predicted [s]", ""), rows)
        + f"\n{left:.0f} s left, {left / workers:.0f} s for {workers} jobs side by side.\n"
    )


def main() -> int:
    options = parsed()
    plan = planned(options)
    try:
        found = jobs(plan)
    except SsilkError as error:
        raise SystemExit(f"error: {error}") from error
    if options.list:
        print(listed(found, max(1, options.gpus) * options.per_gpu))
        return 0
    backlog = Backlog([job for job in found if not job.is_done], plan.folder, options.until)
    gpus: list[int | None] = [*range(options.gpus)] or [None]
    with stop_on_signals(TextReporter()) as stop:
        run(backlog, gpus * options.per_gpu, stop)
    print(
        f"{len(found) - len(backlog.left) - len(backlog.failed)} of {len(found)} jobs are done; failed: "
        f"{', '.join(backlog.failed) or 'none'}; not begun: {', '.join(job.name for job in backlog.left) or 'none'}"
    )
    return 1 if backlog.failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
