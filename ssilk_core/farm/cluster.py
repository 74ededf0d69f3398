# SPDX-License-Identifier: Apache-2.0
"""The tasks of a job on a Ray cluster, which restarts a task when its worker dies."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
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
) -> Iterator[TaskOutcome]:
    """Yield the outcome of each task as it ends, on an existing cluster or on the cores of this machine.

    A task whose device is a GPU reserves one: it waits for it on a cluster that may grow.

    Args:
        bake: what a worker does (`bake_here`), a function of a module that workers can import.
        address: of the cluster; "auto" for the one that this machine is in; None starts one on this machine.
        cores: of this machine, for a cluster that is started here; None for all.

    Raises:
        SsilkError: there is no such cluster, or a task needs a GPU and this machine has none.
    """
    os.environ.setdefault("RAY_DEDUP_LOGS_SKIP_REGEX", ".")  # or Ray writes to standard output, among events
    import ray
    from ray.exceptions import RayError

    try:
        ray.init(address, num_cpus=cores, include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, RuntimeError, ValueError) as error:
        fail("--cluster", f"no cluster at {address} ({str(error).splitlines()[0]})", "start one with 'ray start'")
    try:
        if address is None and any(task.request.needs_gpu for task in tasks):
            _need_gpu(ray.cluster_resources())
        worker = ray.remote(num_cpus=1, max_retries=RETRIES)(_outcome)
        pending = {
            worker.options(num_gpus=int(task.request.needs_gpu)).remote(bake, task, folder.absolute()): task
            for task in tasks
        }
        while pending:
            (done, *_), _ = ray.wait(list(pending))
            task = pending.pop(done)
            try:
                yield ray.get(done)
            except RayError as error:
                yield TaskOutcome(task, error=f"its workers died ({str(error).splitlines()[0]})")
    finally:
        ray.shutdown()


def _need_gpu(resources: Mapping[str, float]) -> None:
    """Fail where no GPU can come: Ray would wait for one for ever."""
    if not resources.get("GPU"):
        fail("--device", "a GPU", "this machine has none", "use --device cpu, or name a cluster")


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
