# SPDX-License-Identifier: Apache-2.0
"""Open Job Description: the bundle that a farm takes, and the lines that a worker prints for it."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

from ...errors import fail
from ...events import Event, Failed, GarmentEvent, Message, Progress, Result, Started, describe
from ...files import need_folder, replacing, split_body, split_location
from ..bake import BakeTask
from ..bake.layered import in_levels
from .job import NAME, FarmJob, is_job, write_job

TEMPLATE, VALUES, ASSETS = "template.json", "parameter_values.json", "asset_references.json"
CHUNK, CHUNK_SECONDS = 10, 300  # tasks of a chunk at first, and how long one should take; both are parameters
NOTICE = 30  # seconds that a worker has to stop
CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")  # what may end or change a line
_STOP = {"mode": "NOTIFY_THEN_TERMINATE", "notifyPeriodInSeconds": NOTICE}


@dataclass(frozen=True, kw_only=True)
class BundleOptions:
    """What a template fixes, because the specification has no parameters for it.

    Attributes:
        memory: of a host [MiB].
        timeout: seconds after which a chunk is cancelled.

    Raises:
        SsilkError: one of them is not positive.
    """

    memory: int = 2048
    timeout: int = 3600

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                fail(f"--{name}", str(value), "a positive number is needed")


def write_bundle(folder: Path, job: FarmJob, output: Path | None, options: BundleOptions) -> None:
    """Write a job bundle: template, job, parameter values and the files that go in and come out.

    Raises:
        SsilkError: it cannot be written, is a file, or would replace files of another program.
    """
    tasks = job.tasks
    need_folder(folder)
    held = [name for name in (NAME, TEMPLATE, VALUES, ASSETS) if (folder / name).is_file()]
    if held and not is_job(folder / NAME):
        fail(
            f"--bundle {folder}",
            f"it holds {', '.join(held)}, and no job of 'ssilk farm'",
            "a bundle has a folder of its own, or replaces one that 'ssilk farm' wrote",
            "name another folder",
        )
    write_job(folder / NAME, job)
    _write(folder / TEMPLATE, template(tasks, options))
    values = [] if output is None else [{"name": "Output", "value": str(output.absolute())}]
    _write(folder / VALUES, {"parameterValues": values})
    _write(folder / ASSETS, _asset_references(tasks, output))


def _write(path: Path, document: dict[str, Any]) -> None:
    with replacing(path, keep_same=True) as temporary:
        temporary.write_text(json.dumps(document, indent=1) + "\n")


def _asset_references(tasks: Sequence[BakeTask], output: Path | None) -> dict[str, Any]:
    places = {split_location(path)[0] for task in tasks for path in task.request.inputs.values()}
    files = sorted({split_body(place)[0] for place in places})
    folders = [] if output is None else [str(output.absolute())]
    return {
        "assetReferences": {"inputs": {"filenames": files, "directories": []}, "outputs": {"directories": folders}}
    }


def template(tasks: Sequence[BakeTask], options: BundleOptions) -> dict[str, Any]:
    """Return a job template; a task that needs a GPU makes every host of the job need one."""
    return {
        "specificationVersion": "jobtemplate-2023-09",
        "extensions": ["TASK_CHUNKING"],
        "name": "SSILK bake",
        "parameterDefinitions": _parameters(),
        "jobEnvironments": [_environment()],
        "steps": _steps(tasks, options),
    }


def _parameters() -> list[dict[str, Any]]:
    return [
        {"name": "Job", "type": "PATH", "objectType": "FILE", "dataFlow": "IN", "default": NAME,
         "description": "What is to be baked."},
        {"name": "Output", "type": "PATH", "objectType": "DIRECTORY", "dataFlow": "OUT", "default": "layers",
         "description": "Where the layers go."},
        {"name": "ChunkSize", "type": "INT", "minValue": 1, "default": CHUNK,
         "description": "Shots that a worker takes at once, at first."},
        {"name": "ChunkSeconds", "type": "INT", "minValue": 0, "default": CHUNK_SECONDS,
         "description": "How long a chunk should take; its size is adapted to it, unless it is 0."},
        {"name": "Ssilk", "type": "STRING", "default": "ssilk", "description": "The command of SSILK on a worker."},
    ]  # fmt: skip


def _environment() -> dict[str, Any]:
    """Return what a session sets up once: one thread for each worker; a host without SSILK fails here."""
    return {
        "name": "SSILK",
        "variables": {"OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"},
        "script": {"actions": {"onEnter": {"command": "{{Param.Ssilk}}", "args": ["--version"], "timeout": 120}}},
    }


def _steps(tasks: Sequence[BakeTask], options: BundleOptions) -> list[dict[str, Any]]:
    """Return the steps: outer garments are refined or certified over inner ones, which are baked in a step before."""
    steps, first = list[dict[str, Any]](), 0
    for number, level in enumerate(in_levels(tasks)):
        name = "BakeOver" + (str(number) if number > 1 else "") if number else "Bake"
        step = _bake_step(name, range(first, first + len(level)), tasks, options)
        steps.append({**step, "dependencies": [{"dependsOn": steps[-1]["name"]}]} if steps else step)
        first += len(level)
    return [*steps, _check_step(steps[-1]["name"], options)]


def _bake_step(name: str, numbers: range, tasks: Sequence[BakeTask], options: BundleOptions) -> dict[str, Any]:
    chunks = {
        "defaultTaskCount": "{{Param.ChunkSize}}",
        "targetRuntimeSeconds": "{{Param.ChunkSeconds}}",
        "rangeConstraint": "CONTIGUOUS",
    }
    shots = {"name": "Shots", "type": "CHUNK[INT]", "range": f"{numbers[0]}-{numbers[-1]}", "chunks": chunks}
    return {
        "name": name,
        "parameterSpace": {"taskParameterDefinitions": [shots]},
        "hostRequirements": _host(tasks, options),
        "script": _script(options, "--tasks", "{{Task.Param.Shots}}"),
    }


def _check_step(after: str, options: BundleOptions) -> dict[str, Any]:
    return {
        "name": "Check",
        "dependencies": [{"dependsOn": after}],
        "script": _script(options, "--check"),
    }


def _host(tasks: Sequence[BakeTask], options: BundleOptions) -> dict[str, Any]:
    amounts = [{"name": "amount.worker.vcpu", "min": 1}, {"name": "amount.worker.memory", "min": options.memory}]
    gpu = any(task.request.needs_gpu for task in tasks)
    return {"amounts": [*amounts, *([{"name": "amount.worker.gpu", "min": 1}] if gpu else [])]}


def _script(options: BundleOptions, *words: str) -> dict[str, Any]:
    arguments = ["task", "{{Param.Job}}", "-o", "{{Param.Output}}", *words, "--openjd"]
    mapping = ["--path-mapping", "{{Session.PathMappingRulesFile}}"]
    run = {"command": "{{Param.Ssilk}}", "args": [*arguments, *mapping], "timeout": options.timeout}
    return {"actions": {"onRun": {**run, "cancelation": _STOP}}}


class OpenJdReporter:
    """Progress, status and failures as the lines that Open Job Description's sessions read."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self.stream = stream or sys.stdout
        self.percent = -1

    def __call__(self, event: Event) -> None:
        match event:
            case Progress():
                self._progress(100 * event.done / max(event.total, 1))
            case GarmentEvent(name, Started(task)):
                self._say(f"openjd_status: {task} {name}")
            case Failed() | GarmentEvent(_, Failed()):
                self._say(f"openjd_fail: {describe(event)}")
            case GarmentEvent(name, Result(_, detail)):
                self._say(f"{name}: " + ", ".join(f"{key} {value}" for key, value in detail.items()))
            case Result(_, detail):
                self._say(", ".join(f"{key} {value}" for key, value in detail.items()))
            case Message() | GarmentEvent():
                text = describe(event)
                self._say(f" {text}" if text.startswith("openjd_") else text)  # a name is no command

    def _progress(self, percent: float) -> None:
        if int(percent) > self.percent:  # sessions log each line
            self.percent = int(percent)
            self._say(f"openjd_progress: {percent:.1f}")

    def _say(self, text: str) -> None:
        """Print one line: a line break in a file's name would begin another, which sessions might obey."""
        text = CONTROL.sub(lambda found: found[0].encode("unicode_escape").decode(), text)
        print(text, file=self.stream, flush=True)
