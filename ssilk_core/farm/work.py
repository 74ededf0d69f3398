# SPDX-License-Identifier: Apache-2.0
"""What a farm's worker does with the tasks of a job: bake them one after the other, or check that all are done."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..bake import BakeTask, LayerFolder
from ..errors import SsilkError, VerificationError
from ..events import Event, Failed, GarmentEvent, Message, Progress, Reporter, Result, Started


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


def check_tasks(tasks: Sequence[BakeTask], folder: Path, report: Reporter) -> None:
    """Remove what killed workers left half written, and write the stage of each shot.

    Raises:
        VerificationError: a task is not done, or its files are not as they were written.
    """
    layers = LayerFolder(folder)
    layers.remove_unfinished(tasks)
    faults: set[str] = set()
    done = [task for task in tasks if _is_done(layers, task, faults, report)]
    layers.write_stages(done, report)
    missing = sorted(task.name for task in set(tasks).difference(done))
    if missing:
        raise VerificationError(
            f"{folder}: {len(missing)} of {len(tasks)} tasks are not done, or their files are not as they were "
            f"written ({', '.join(missing[:5])}); run them again."
        )
    report(Result("check", {"tasks": len(tasks), "output": str(folder)}))


def _is_done(layers: LayerFolder, task: BakeTask, faults: set[str], report: Reporter) -> bool:
    """Return whether a task is done; report each fault of an input once, however many tasks have it."""
    try:
        return layers.is_done(task)
    except SsilkError as error:
        if str(error) not in faults:
            faults.add(str(error))
            report(Message(f"{task.name}: {error}", "warning"))
        return False
