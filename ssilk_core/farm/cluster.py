# SPDX-License-Identifier: Apache-2.0
"""The tasks of a job on a Python cluster: Ray starts them, and starts those anew whose worker died."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from ..errors import SsilkError, fail
from .tasks import BakeTask

Bake = Callable[[BakeTask, Path], dict[str, object]]
RETRIES = 10  # of a task whose worker died


@dataclass(frozen=True)
class TaskOutcome:
    """How a task ended: `detail` as the bake says it, or what was wrong."""

    task: BakeTask
    detail: dict[str, object]
    error: str = ""


def run_on_cluster(
    tasks: Sequence[BakeTask],
    folder: Path,
    bake: Bake,
    *,
    address: str | None = None,
    cores: int | None = None,
    gpu: bool = False,
) -> Iterator[TaskOutcome]:
    """Yield the outcome of each task as it ends, on a cluster that is there or on the cores of this machine.

    Args:
        bake: what a worker does, a function of a module that workers can import.
        address: of the cluster, "auto" for the one that this machine is in; None starts one here.
        cores: how many of this machine's, where a cluster is started here; None for all.
        gpu: each task needs a GPU.

    Raises:
        SsilkError: there is no such cluster.
    """
    os.environ.setdefault("RAY_DEDUP_LOGS_SKIP_REGEX", ".")  # Ray's own words went to standard output, among events
    import ray
    from ray.exceptions import RayError

    try:
        ray.init(address, num_cpus=cores, include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, RuntimeError, ValueError) as error:
        fail("--cluster", f"no cluster at {address} ({str(error).splitlines()[0]})", "start one with 'ray start'")
    try:
        worker = ray.remote(num_cpus=1, num_gpus=int(gpu), max_retries=RETRIES)
        remote = worker(_outcome)
        pending = {remote.remote(bake, task, folder.absolute()): task for task in tasks}
        while pending:
            (done, *_), _ = ray.wait(list(pending))
            task = pending.pop(done)
            try:
                yield ray.get(done)
            except RayError as error:
                yield TaskOutcome(task, {}, f"its workers died ({str(error).splitlines()[0]})")
    finally:
        ray.shutdown()


def _outcome(bake: Bake, task: BakeTask, folder: Path) -> TaskOutcome:
    try:
        return TaskOutcome(task, bake(task, folder))
    except SsilkError as error:
        return TaskOutcome(task, {}, str(error))
