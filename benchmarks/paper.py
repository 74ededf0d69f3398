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
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from helpers.paper_jobs import GARMENTS, PYTHON, TABLES, Job, Plan, jobs, without_models
from helpers.reports import table

from ssilk_core.errors import SsilkError

WAIT = 0.2  # [s] between looks for a job that can begin
ROOT = Path(__file__).parent.parent
PATHS = (ROOT, ROOT / "usd", ROOT / "benchmarks")


@dataclass
class Queue:
    """Jobs, the most important first. Workers take each as soon as the jobs that it needs have ended, well or not."""

    left: list[Job]
    until: float
    running: list[Job] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    lock: threading.Lock = field(default_factory=threading.Lock)
    began: float = field(default_factory=time.monotonic)

    @property
    def elapsed(self) -> float:
        return time.monotonic() - self.began

    def take(self) -> Job | None:
        """Return the next job that can begin and end in time, or nothing; it counts as running."""
        with self.lock:
            pending = {path for job in (*self.left, *self.running) for path in job.outputs}
            for job in self.left:
                if not pending & set(job.needs) and self.elapsed + job.seconds <= self.until:
                    self.left.remove(job)
                    self.running.append(job)
                    return job
        return None

    @property
    def is_over(self) -> bool:
        """Whether nothing is running and nothing more can begin."""
        with self.lock:
            waiting = [job for job in self.left if self.elapsed + job.seconds <= self.until]
            return not self.running and not self._can_begin(waiting)

    def _can_begin(self, waiting: Sequence[Job]) -> bool:
        pending = {path for job in self.left for path in job.outputs}
        return any(not pending & set(job.needs) for job in waiting)

    def ended(self, job: Job, told: str) -> None:
        """Say how a job ended, and let those go on that wait for it."""
        with self.lock:
            self.running.remove(job)
            self.failed += [] if job.is_done else [job.name]
        print(f"[{self.elapsed:5.0f} s] {job.name}: {told}", flush=True)


def work(queue: Queue, plan: Plan, gpu: int | None) -> None:
    """Run jobs on one GPU until there is none left."""
    while not queue.is_over:
        if job := queue.take():
            queue.ended(job, _run(without_models(job), plan.folder, gpu))
        else:
            time.sleep(WAIT)


def _run(job: Job, folder: Path, gpu: int | None) -> str:
    """Run a job with its output in a log; return how it ended."""
    words = [sys.executable if word == PYTHON else word for word in job.command]
    places = os.pathsep.join([*map(str, PATHS), *filter(None, [os.environ.get("PYTHONPATH")])])
    own = {} if gpu is None else {"CUDA_VISIBLE_DEVICES": str(gpu)}
    log, began = folder / "logs" / f"{job.name}.log", time.monotonic()
    log.parent.mkdir(parents=True, exist_ok=True)
    for output in job.outputs:
        output.parent.mkdir(parents=True, exist_ok=True)
    with log.open("w") as stream:
        code = subprocess.run(
            words, cwd=ROOT, stdout=stream, stderr=subprocess.STDOUT, env={**os.environ, "PYTHONPATH": places, **own}
        ).returncode  # fmt: skip
    taken = f"{time.monotonic() - began:.0f} s (predicted {job.seconds:.0f})"
    last = (log.read_text().strip().splitlines() or ["no output"])[-1]
    return f"{taken} on GPU {gpu}" if job.is_done and code == 0 else f"FAILED with code {code} after {taken}: {last}"


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
    queue = Queue([job for job in found if not job.is_done], options.until)
    gpus: list[int | None] = [*range(options.gpus)] or [None]
    workers = [threading.Thread(target=work, args=(queue, plan, gpu)) for gpu in gpus * options.per_gpu]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    print(
        f"{len(found) - len(queue.left) - len(queue.failed)} of {len(found)} jobs are done; failed: "
        f"{', '.join(queue.failed) or 'none'}; not begun: {', '.join(job.name for job in queue.left) or 'none'}"
    )
    return 1 if queue.failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
