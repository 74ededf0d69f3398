# SPDX-License-Identifier: Apache-2.0
"""The tasks of a job on a Ray cluster, which restarts a task when its worker dies."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from ..bake import BakeResult, BakeTask, LayerFolder
from ..errors import SsilkError, fail

BakeFunction = Callable[[BakeTask, Path], BakeResult]
RETRIES = 10  # of a task whose worker died


@dataclass(frozen=True)
class TaskOutcome:
    """How a task ended: with a result, or with what was wrong."""

    task: BakeTask
    result: BakeResult | None = None
    error: str = ""


def run_on_cluster(
    tasks: Sequence[BakeTask],
    folder: Path,
    bake: BakeFunction,
    *,
    address: str | None = None,
    cores: int | None = None,
    gpu: bool = False,
) -> Iterator[TaskOutcome]:
    """Yield the outcome of each task as it ends, on an existing cluster or on the cores of this machine.

    Args:
        bake: what a worker does (`bake_here`), a function of a module that workers can import.
        address: of the cluster; "auto" for the one that this machine is in; None starts one on this machine.
        cores: of this machine, for a cluster that is started here; None for all.
        gpu: each task needs a GPU.

    Raises:
        SsilkError: there is no such cluster.
    """
    os.environ.setdefault("RAY_DEDUP_LOGS_SKIP_REGEX", ".")  # or Ray writes to standard output, among events
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
                yield TaskOutcome(task, error=f"its workers died ({str(error).splitlines()[0]})")
    finally:
        ray.shutdown()


def _outcome(bake: BakeFunction, task: BakeTask, folder: Path) -> TaskOutcome:
    try:
        return TaskOutcome(task, bake(task, folder))
    except SsilkError as error:
        return TaskOutcome(task, error=str(error))


def bake_here(task: BakeTask, folder: Path) -> BakeResult:
    """Bake a task in this process, which keeps the garment of its last task."""
    return _layer_folder(folder).bake(task)


@lru_cache(maxsize=1)
def _layer_folder(folder: Path) -> LayerFolder:
    return LayerFolder(folder)
