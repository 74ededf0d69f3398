# SPDX-License-Identifier: Apache-2.0
"""What a farm's worker does with the tasks of a job: bake them one after the other, or check that all are done."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from ...errors import SsilkError, VerificationError
from ...events import Event, Failed, GarmentEvent, Message, Progress, Reporter, Result, Started
from ..bake import BakeTask, LayerFolder
from ..bake.inputs import InputFiles, InputHashes, need_pinned
from ..bake.layered import tell_layers
from ..bake.shots import STAGE, finished
from ..bake.stated_layers import all_stated
from .job import FarmJob

READERS = 16  # threads that read files for a check


def bake_tasks(tasks: Sequence[BakeTask], folder: Path, report: Reporter) -> list[BakeTask]:
    """Bake tasks into a folder of layers; return those that failed, each of which fails alone."""
    layers, failed = LayerFolder(folder), []
    for index, task in enumerate(tasks):
        report(GarmentEvent(task.name, Started("bake", 1)))
        try:
            result = layers.bake(task, report=_part(report, index, len(tasks)))
            report(GarmentEvent(task.name, Result("bake", result.figures("layer"))))
        except SsilkError as error:
            failed.append(task)
            report(GarmentEvent(task.name, Failed(str(error))))
        report(Progress(index + 1, len(tasks)))
    return failed


def _part(report: Reporter, index: int, count: int) -> Reporter:
    """Return a reporter for one of several tasks, whose progress is a part of the whole."""

    def part(event: Event) -> None:
        if isinstance(event, Progress):
            report(Progress(index * event.total + event.done, count * event.total))
        else:
            report(event)

    return part


def check_tasks(job: FarmJob, folder: Path, report: Reporter) -> None:
    """Remove what killed workers left half written, and write the stage of each shot; count its garments over others.

    Raises:
        VerificationError: a task is not done, an input is not what the job was submitted with, files are not as they
            were written, or the stage of a shot cannot be written.
    """
    layers, tasks = LayerFolder(folder, InputFiles(job.inputs)), job.tasks
    layers.remove_unfinished(tasks)
    with ThreadPoolExecutor(READERS) as readers:  # most of the time goes into waiting for a file system
        list(readers.map(layers.inputs.still_there, job.inputs.values()))
        wanted = _as_submitted(layers.inputs, tasks, report)
        written = readers.map(layers.is_written, wanted, wanted.values())
        done = [task for task, there in zip(wanted, written) if there]
    fault = ""
    try:
        layers.write_stages(done, report)
    except SsilkError as error:
        fault = str(error)
    missing = sorted(task.name for task in set(tasks).difference(done))
    if missing:
        if fault:
            report(Message(fault, "warning"))
        raise VerificationError(
            f"{folder}: {len(missing)} of {len(tasks)} tasks are not done, or their files are not as they were "
            f"written ({', '.join(missing[:5])}); run them again."
        )
    if fault:
        raise VerificationError(fault)
    for shot in dict.fromkeys(task.shot for task in tasks):
        if not all_stated(folder / "shots" / shot / STAGE, finished(folder, shot)):
            tell_layers(folder, shot, report, "check")
    report(Result("check", {"tasks": len(tasks), "output": str(folder)}))


def _as_submitted(inputs: InputFiles, tasks: Sequence[BakeTask], report: Reporter) -> dict[BakeTask, InputHashes]:
    """Return the tasks whose inputs are as they were submitted, and what they hold; report each fault once.

    Not in threads: USD opens inputs of which it is not known what files they consist of.
    """
    found: dict[BakeTask, InputHashes] = {}
    faults: set[str] = set()
    digests: dict[str, str] = {}
    for name, path in dict.fromkeys(item for task in tasks for item in task.request.inputs.items()):
        try:
            digests[path] = inputs.digest(name, path)
        except SsilkError as error:
            report(Message(str(error), "warning"))
    for task in tasks:
        if not all(path in digests for path in task.request.inputs.values()):
            continue
        hashes = InputHashes(**{name: digests[path] for name, path in task.request.inputs.items()})
        try:
            if task.pinned:
                need_pinned(task.request, task.pinned, hashes)
            found[task] = hashes
        except SsilkError as error:
            if str(error) not in faults:
                faults.add(str(error))
                report(Message(str(error), "warning"))
    return found
