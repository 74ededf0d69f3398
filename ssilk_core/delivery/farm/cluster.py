# SPDX-License-Identifier: Apache-2.0
"""The tasks of a job on a Ray cluster, which restarts a task when its worker dies."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from ...errors import EXIT_INTERRUPTED, SsilkError, fail
from ..bake import BakeResult, BakeTask, LayerFolder
from .watchdog import ended_together

BakeFunction = Callable[[BakeTask, Path], BakeResult]
RETRIES = 10  # of a task whose worker died
STARTS = 5  # of a cluster on this machine, which may end before its tasks do
WINDOW = 1000  # tasks that the cluster knows of at once: waiting takes a time that grows with their number


class NoClusterError(SsilkError):
    """There is no cluster where one was sought, or none could be started."""


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
        SsilkError: a task needs a GPU and this machine has none, or, as `NoClusterError`, there is no such cluster.

    A cluster of this machine that ends before its tasks do is started again, a few times, and so is one that does not
    start, once; all of its processes end with this one.
    """
    left, starts = dict.fromkeys(tasks), 1 if address else STARTS
    started = True
    for number in range(1, starts + 1):
        try:
            with ended_together() if address is None else nullcontext():
                for outcome in _apart([*left], folder.absolute(), bake, address, cores):
                    del left[outcome.task]
                    yield outcome
            started = True
        except NoClusterError:  # Ray says the same where its raylet is killed meanwhile
            if not started or number == starts:
                raise
            started = False
        if not left:
            return
    ended = f"the cluster ended {starts} times" if starts > 1 else "this machine's part of the cluster ended"
    for task in left:
        yield TaskOutcome(task, error=f"{ended}; run the same command again, finished tasks stay.")


def _apart(
    tasks: Sequence[BakeTask], folder: Path, bake: BakeFunction, address: str | None, cores: int | None
) -> Iterator[TaskOutcome]:
    """Yield the outcome of each task as it ends, from a process of its own; fewer where that ends before them.

    Ray ends the process that uses it where a raylet is lost while they connect.
    """
    context: Any = get_context("fork" if sys.platform == "linux" else "spawn")
    outcomes, sender = context.Pipe(duplex=False)
    process = context.Process(target=_drive, args=(sender, tasks, folder, bake, address, cores))
    process.start()
    sender.close()  # so that the end of the process is the end of the outcomes
    try:
        while True:
            said = outcomes.recv()
            if isinstance(said, SsilkError):
                raise said
            yield said
    except EOFError:
        pass
    except BaseException:
        process.kill()  # Ray sees to the rest of it
        raise
    finally:
        process.join()


def _drive(
    sender: Connection[TaskOutcome | SsilkError, None],
    tasks: Sequence[BakeTask],
    folder: Path,
    bake: BakeFunction,
    address: str | None,
    cores: int | None,
) -> None:
    """Send outcomes, or the error that there is no cluster; end when the process that receives them does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # which a terminal sends to both
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        with _connected(address, cores):
            for outcome in _outcomes(tasks, folder, bake, here=address is None):
                sender.send(outcome)
    except SsilkError as error:
        sender.send(error)


def _end_with_parent() -> None:
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(EXIT_INTERRUPTED)


@contextmanager
def _connected(address: str | None, cores: int | None) -> Iterator[None]:
    """Be part of a cluster meanwhile; raise `SsilkError` where there is none."""
    os.environ.setdefault("RAY_DEDUP_LOGS_SKIP_REGEX", ".")  # or Ray writes to standard output, among events
    import ray

    try:
        ray.init(address, num_cpus=cores, include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR)
    except Exception as error:  # Ray says nowhere which ones there are
        where = f"at {address}" if address else "on this machine"
        raise NoClusterError(
            f"--cluster: no cluster {where} ({_first_line(error)}); start one with 'ray start'."
        ) from error
    try:
        yield
    finally:
        ray.shutdown()


def _outcomes(tasks: Sequence[BakeTask], folder: Path, bake: BakeFunction, *, here: bool) -> Iterator[TaskOutcome]:
    """Yield the outcome of each task as it ends, until the cluster ends.

    Args:
        here: the cluster is this machine alone.
    """
    import ray
    from ray.exceptions import LocalRayletDiedError, NodeDiedError, RayError

    if here and any(task.request.needs_gpu for task in tasks):
        _need_gpu(ray.cluster_resources())
    worker = ray.remote(num_cpus=1, max_retries=RETRIES)(_outcome)
    waiting, pending = iter(tasks), dict[Any, BakeTask]()
    while True:
        for task in islice(waiting, WINDOW - len(pending)):
            options = worker.options(num_gpus=int(task.request.needs_gpu))
            pending[options.remote(bake, task, folder)] = task
        if not pending:
            return
        (done, *_), _ = ray.wait(list(pending))
        task = pending.pop(done)
        try:
            yield ray.get(done)
        except RayError as error:
            if isinstance(error, LocalRayletDiedError) or (here and isinstance(error, NodeDiedError)):
                return
            yield TaskOutcome(task, error=f"its workers died ({_first_line(error)})")


def _first_line(error: Exception) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__)


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
