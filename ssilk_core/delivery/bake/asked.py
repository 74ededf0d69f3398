# SPDX-License-Identifier: Apache-2.0
"""Whether inputs have what requests ask of them, before anything is baked."""

from __future__ import annotations

from collections.abc import Container, Sequence
from functools import lru_cache

import numpy as np

from ...errors import SsilkError
from ...events import Event, Message, Reporter
from ...files import split_location
from ...network.checkpoint import load_model
from ...scene.assets import Motion, Scene
from .bodies import worn
from .direction import need_moving, stated_at
from .fabrics import in_fabric
from .looped import need_alone
from .request import BakeRequest
from .task import BakeTask
from .world import asked_world

MODELS = 8  # that are kept, to bound memory


def tell_impossible(tasks: Sequence[BakeTask], readable: Container[str], report: Reporter) -> None:
    """Warn of tasks that will fail, as far as that can be known without reading poses, each fault once.

    That is fabrics that models have not or were not trained for, characters that they do not dress, ranges that
    motions have not, colliders that are none, and what stages say of a garment that options do not go with.

    Args:
        readable: inputs that can be read: tasks with others fail for that.

    Raises:
        SsilkError: no task is left.
    """
    left = [task for task in tasks if all(path in readable for path in task.request.inputs.values())]
    told, known = set[str](), _Known()
    for asked, found in (
        (_fabric, known.in_fabric),
        (_body, known.of_body),
        (_range, known.of_range),
        (_shot, known.of_shot),
    ):
        groups: dict[tuple[object, ...], list[BakeTask]] = {}
        for task in left:
            groups.setdefault(asked(task.request), []).append(task)
        for alike in groups.values():
            try:
                events = found(alike[0].request)
            except SsilkError as error:
                lost = {task.name for task in alike}
                left = [task for task in left if task.name not in lost]
                if not left:
                    raise
                events = (Message(str(error), "warning"),)
            for event in events:
                if str(event) not in told:
                    told.add(str(event))
                    report(event)


def need_bodies(tasks: Sequence[BakeTask]) -> None:
    """Raise `SsilkError` where a model does not dress the body of a task, before any is baked."""
    known = _Known()
    for request in {_body(task.request): task.request for task in tasks}.values():
        known.of_body(request)


class _Known:
    """Garments on their characters, and frames of shots, each read once for all tasks."""

    def __init__(self) -> None:
        self._scenes: dict[tuple[object, ...], Scene] = {}
        self._frames: dict[tuple[object, ...], Motion] = {}
        self._model = lru_cache(MODELS)(load_model)

    def in_fabric(self, request: BakeRequest) -> tuple[Event, ...]:
        if not (request.fabric or request.material):
            return ()
        model = self._model(request.model)
        return in_fabric(model, request.model, request.fabric, request.material, request.feedback)[1]

    def of_body(self, request: BakeRequest) -> tuple[Event, ...]:
        from ssilk_usd.opening.stage import open_stage

        on = worn(self._model(request.model), open_stage(request.stage), request.root)
        self._scenes[_body(request)] = on.scene
        return on.told

    def of_range(self, request: BakeRequest) -> tuple[Event, ...]:
        self._frames[_range(request)] = _frames(request)
        return ()

    def of_shot(self, request: BakeRequest) -> tuple[Event, ...]:
        from ssilk_usd.reading.direction import read_direction, read_loop
        from ssilk_usd.reading.world import find_world

        scene, motion = self._scenes[_body(request)], self._frames[_range(request)]
        mesh, shot = scene.garment.mesh, (request.motion, request.stage)
        asked = asked_world(request.colliders, request.wind, request.gusts, request.gravity)
        find_world(*shot, scene.character, motion, asked, garment=split_location(mesh.path)[1])
        if request.lbs:
            return ()
        places = stated_at(mesh, request.stage, request.root)
        said = read_direction(*shot, places, motion, scene.rig.joint_names)
        need_moving(request, request.hold or said.hold)
        if request.loop or read_loop(*shot, places, motion):
            need_alone(request)
        return tuple(Message(text, "warning") for text in said.unheard)


def _frames(request: BakeRequest) -> Motion:
    """Return the frames of a request's shot, in which nothing is posed."""
    from ssilk_usd.opening.stage import location, open_stage
    from ssilk_usd.reading.frame_range import read_frame_range
    from ssilk_usd.reading.motion import find_animation

    found = read_frame_range(request.motion, request.time_range, root=request.root)
    count, fps, start = (found.count + 1, found.fps, found.first / found.step) if found else (1, 1.0, 0.0)
    file, prim = split_location(request.motion)
    shot = open_stage(file)  # prims live as long as it
    path = location(find_animation(shot, prim, request.root)[0])
    return Motion(path, fps, np.ones((count, 1, 4)), np.zeros((count, 1, 3)), start)


def _fabric(request: BakeRequest) -> tuple[object, ...]:
    return request.model, request.feedback, request.fabric, request.material


def _body(request: BakeRequest) -> tuple[object, ...]:
    return request.model, request.stage, request.root


def _range(request: BakeRequest) -> tuple[object, ...]:
    return request.motion, request.root, request.range


def _shot(request: BakeRequest) -> tuple[object, ...]:
    return *_body(request), *_range(request)
