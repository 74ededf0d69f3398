# SPDX-License-Identifier: Apache-2.0
"""Whether inputs have what requests ask of them, before anything is baked."""

from __future__ import annotations

from collections.abc import Container, Sequence

from ...errors import SsilkError
from ...events import Event, Message, Reporter
from ...files import split_body
from ...network.checkpoint import load_model
from .fabrics import in_fabric
from .request import BakeRequest
from .task import BakeTask


def tell_impossible(tasks: Sequence[BakeTask], readable: Container[str], report: Reporter) -> None:
    """Warn of fabrics that models have not or were not trained for, and of what stages and motions have not.

    That is blendshapes that make a body, and ranges.

    Args:
        readable: inputs that can be read: tasks with others fail for that.

    Raises:
        SsilkError: no task is left.
    """
    lost = {task.name for task in tasks if any(path not in readable for path in task.request.inputs.values())}
    tasks, count = [task for task in tasks if task.name not in lost], len(tasks)
    for asked, found in ((_fabric, _in_fabric), (_body, _of_shapes), (_range, _in_range)):
        groups: dict[tuple[str, ...], list[BakeTask]] = {}
        for task in tasks:
            if key := asked(task.request):
                groups.setdefault(key, []).append(task)
        for alike in groups.values():
            try:
                for event in found(alike[0].request):
                    report(event)
            except SsilkError as error:
                lost |= {task.name for task in alike}
                if len(lost) == count:
                    raise
                report(Message(str(error), "warning"))


def _fabric(request: BakeRequest) -> tuple[str, ...]:
    asked = [request.fabric] if request.fabric else []
    rubs = ["feedback"] if request.feedback else []
    return (request.model, *rubs, *asked, *request.material) if asked or request.material else ()


def _in_fabric(request: BakeRequest) -> tuple[Event, ...]:
    return in_fabric(load_model(request.model), request.model, request.fabric, request.material, request.feedback)[1]


def _body(request: BakeRequest) -> tuple[str, ...]:
    return (request.stage,) if split_body(request.stage)[1] else ()


def _of_shapes(request: BakeRequest) -> tuple[Event, ...]:
    from ssilk_usd.opening.stage import open_stage

    open_stage(request.stage)  # refuses shapes that it has not, and weights beyond their ranges
    return ()


def _range(request: BakeRequest) -> tuple[str, ...]:
    return (request.motion, request.root or "", request.range) if request.range else ()


def _in_range(request: BakeRequest) -> tuple[Event, ...]:
    from ssilk_usd.reading.frame_range import read_frame_range

    read_frame_range(request.motion, request.time_range, root=request.root)
    return ()
