# SPDX-License-Identifier: Apache-2.0
"""Garments of a shot over one another: whether they were trained so, and how one lies over the other."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from ...events import Message, Reporter, Result
from ...files import sha256
from ...network.checkpoint import load_model
from ...physics.intersections.figures import EVERY, NOT_COUNTED, LayerFigures
from ...physics.intersections.pairs import can_find
from ...scene.assets import Floats, Mesh
from .opened import open_shot
from .record import TaskRecord
from .shots import STAGE, finished, write_shot_stage
from .stated_layers import layer_facts, stated_layers, worn_pairs
from .task import BakeTask

if TYPE_CHECKING:
    from ssilk_usd.shots.play import Shot

    from ...physics.intersections.layers import ClothLayers
    from ..gltf.play import GlbShot

FRAMES_AT_ONCE = 32


def tell_other_layers(folder: Path, shot: str, report: Reporter) -> None:
    """Warn of garments of a shot that were trained over others than lie beneath them there."""
    found = whole(finished(folder, shot))
    for name, record in found.items():
        together = {name: record, **_beside(found, name)}
        models = {each: (own.inputs["model"].sha256, own.over) for each, own in together.items()}
        if text := over_others(name, models):
            report(Message(f"{shot}/{name}: {text}", "warning"))


def over_others(name: str, models: Mapping[str, tuple[str, Mapping[str, str]]]) -> str:
    """Return in words that a garment was trained over others than it is worn with; empty where it was not.

    Args:
        models: of it and of those that it is worn with, by name: the SHA-256 of each, and those of the models that it
            was trained over, by their names.
    """
    model, over = models[name]
    others = [
        other
        for other, (own, beneath) in models.items()
        if own not in {*over.values(), model} and model not in beneath.values()
    ]
    if not (over and others):
        return ""
    listed = ", ".join(f"'{each}'" for each in over)
    text = f"it was trained over {listed}, and {', '.join(others)} of this shot is another model"
    return f"{text}; train it over what it is worn with ('ssilk train --over'), or cloth may pass through cloth"


def tell_layers(folder: Path, shot: str, report: Reporter, verb: str = "bake") -> list[LayerFigures]:
    """Count how garments of a shot that one character wears lie over one another; the stage says it, and a report.

    Of two, the outer is the one that was trained over the other; else the one that covers more of it.

    Args:
        verb: the work whose result this is. "verify" writes nothing, and warns where the stage says otherwise.

    Returns:
        The figures of each pair that could touch: one covers some of the other, or crosses it. None without libigl,
        which is told.

    Raises:
        SsilkError: a layer cannot be read.
    """
    found = whole(finished(folder, shot))
    pairs = worn_pairs(found)
    if pairs and not can_find():
        report(Message(f"{folder / 'shots' / shot}: cloth through other garments is {NOT_COUNTED}", "warning"))
        return []
    counted = [_counted(folder, shot, found, *pair) for pair in pairs]
    touching = [each for each in counted if each and (each.shown is not None or each.worst)]
    for each in touching:
        named = {"shot": shot, "garment": each.outer, "over": each.inner}
        report(Result(verb, {**named, **each.summary("time code")}))
    stage = folder / "shots" / shot / STAGE
    if verb != "verify":
        if stage.is_file():
            write_shot_stage(folder, shot, facts=layer_facts(touching, found))
        return touching
    said = {(each.outer, each.inner): each.to_metadata() for each in stated_layers(stage, found)}
    for each in touching:
        if said.get((each.outer, each.inner), each.to_metadata()) != each.to_metadata():
            text = f"{stage}: it says something else of {each.outer} over {each.inner} than was counted in its layers"
            report(Message(f"{text}; bake one of the two again", "warning"))
    return touching


def tell_over(path: Path, beneath: Mapping[str, Path], report: Reporter) -> None:
    """Count how a garment lies over those beneath it, each in a file of its own, and report it.

    Args:
        path: the garment's file.
        beneath: files of the others, by their names.

    Raises:
        SsilkError: a file cannot be read.
    """
    if not can_find():
        report(Message(f"{path}: cloth through other garments is {NOT_COUNTED}", "warning"))
        return
    from ...physics.intersections.layers import ClothLayers

    outer = _Layer(open_shot(path))
    for name, file in beneath.items():
        inner = _Layer(open_shot(file))
        cloth = ClothLayers((path.stem, name), outer.rest, inner.rest, _body(outer, inner))
        if figures := _figures(cloth, outer, inner, path.stem):
            named = {"shot": str(path), "garment": path.stem, "over": name}
            report(Result("bake", {**named, **figures.summary("time code")}))


def inner_first(tasks: Sequence[BakeTask]) -> list[BakeTask]:
    """Return tasks with those of garments first that others of them were trained over, else in their order.

    Raises:
        SsilkError: a model cannot be read.
    """
    over = trained_over({task.request.model for task in tasks})
    return sorted(tasks, key=lambda task: depth(task.request.model, over))


def put_over(tasks: Sequence[BakeTask], report: Reporter) -> list[BakeTask]:
    """Return tasks as `inner_first` does, each with those of its shot and character that it is refined or certified
    over.

    One whose model was trained over another one that is not among them does without that, with a warning.

    Raises:
        SsilkError: a model cannot be read.
    """
    over = trained_over({task.request.model for task in tasks})
    digests = {model: load_model(Path(model)).provenance.get("over") or {} for model in over}
    worn: dict[object, list[BakeTask]] = {}
    for task in tasks:
        worn.setdefault(_worn_in(task), []).append(task)
    found = []
    for task in inner_first(tasks):
        model, names = str(task.request.model), tuple[str, ...]()
        if task.request.meets_beneath:
            together = [other for other in worn[_worn_in(task)] if not other.level_of]
            names = tuple(other.garment for other in together if str(other.request.model) in over[model])
            if len(names) < len(digests[model]):
                text = f"it was trained over {', '.join(digests[model])}; the job has {', '.join(names) or 'none'}"
                told = f"{task.name}: {text} of these in its shot, and puts it over no others"
                report(Message(told, "warning"))
        found.append(replace(task, over=names))
    return found


def _worn_in(task: BakeTask) -> tuple[str | None, ...]:
    """Return what garments of one character in one shot share."""
    return task.shot, task.request.stage, task.request.motion, task.request.root


def in_levels(tasks: Sequence[BakeTask]) -> list[list[BakeTask]]:
    """Return tasks in groups, each of which is put over garments of groups before it alone."""
    left, levels = list(tasks), list[list[BakeTask]]()
    while left:
        waiting = {(task.shot, task.garment) for task in left}
        blocked = [any((task.shot, name) in waiting for name in task.over) for task in left]
        if all(blocked):  # a damaged job, whose tasks name each other: each fails with a sentence
            return [*levels, left]
        levels.append([task for task, waits in zip(left, blocked) if not waits])
        left = [task for task, waits in zip(left, blocked) if waits]
    return levels


def trained_over(models: Iterable[str | Path]) -> dict[str, list[str]]:
    """Return those of some models that each was trained over, by their paths.

    Raises:
        SsilkError: a model cannot be read.
    """
    known = {str(path): Path(path) for path in models}
    digests = {name: sha256(path) for name, path in known.items() if path.is_file()}
    found = {}
    for name, path in known.items():
        over = (load_model(path).provenance.get("over") or {}).values()
        found[name] = [other for other, digest in digests.items() if other != name and digest in over]
    return found


def depth(model: str | Path, over: Mapping[str, Sequence[str]]) -> int:
    """Return how many garments lie beneath one another below that of a model."""
    return max((1 + depth(other, over) for other in over[str(model)]), default=0)


def whole(found: Mapping[str, TaskRecord | None]) -> dict[str, TaskRecord]:
    """Return the records that can be read, without levels of quality of other garments."""
    return {name: record for name, record in found.items() if record and not record.level_of}


def _beside(found: Mapping[str, TaskRecord], name: str) -> dict[str, TaskRecord]:
    """Return the other garments on the character that wears one."""
    return {other: own for other, own in found.items() if other != name and own.wearer == found[name].wearer}


def _counted(folder: Path, shot: str, found: Mapping[str, TaskRecord], one: str, other: str) -> LayerFigures | None:
    """Count in every `EVERY`-th frame that two garments have, as their layers play it; None where they share none."""
    from ssilk_usd.shots.layers import Layout

    from ...physics.intersections.layers import ClothLayers

    both = {name: _Layer(open_shot(Layout(folder, name, shot).animation)) for name in (one, other)}
    body = _body(both[one], both[other])
    if _is_over(found[one], found[other]):
        cloth = ClothLayers((one, other), both[one].rest, both[other].rest, body)
    elif _is_over(found[other], found[one]):
        cloth = ClothLayers((other, one), both[other].rest, both[one].rest, body)
    else:
        cloth = ClothLayers.by_cover((one, both[one].rest), (other, both[other].rest), body)
    over, under = (both[name] for name in cloth.names)
    return _figures(cloth, over, under, shot)


def _body(one: _Layer, other: _Layer) -> Mesh | None:
    from ...scene.mesh.joined import joined

    return joined(one.bodies or other.bodies)


def _figures(cloth: ClothLayers, over: _Layer, under: _Layer, shot: str) -> LayerFigures | None:
    """Count in every `EVERY`-th frame that two garments have; None where they share none."""
    shared = set(under.shot.frame_times)
    times = [time for time in over.shot.frame_times if time in shared][::EVERY]
    if not times:
        return None
    parts = []
    for first in range(0, len(times), FRAMES_AT_ONCE):
        some = times[first : first + FRAMES_AT_ONCE]
        parts.append((shot, cloth.counts(over.points(some), under.points(some), some)))
    return cloth.figures(parts)


def _is_over(outer: TaskRecord, inner: TaskRecord) -> bool:
    """Return whether a garment's model was trained over that of another one."""
    return inner.inputs["model"].sha256 in outer.over.values()


class _Layer:
    """A garment in a layer of its own.

    Attributes:
        rest: its mesh in the bind pose.
        bodies: those of its character that are there, of a stage of USD.
    """

    def __init__(self, shot: Shot | GlbShot) -> None:
        from ssilk_usd.shots.read import read_parts

        from ..gltf.play import GlbShot

        self.shot, self.bodies = shot, list[Mesh]()
        if isinstance(shot, GlbShot):
            self.rest = shot.garment_at_rest
            return
        meshes = [part.mesh for part in read_parts(shot)]
        self.rest = next(mesh for mesh, own in zip(meshes, shot.meshes) if own.is_garment)
        self.bodies = [mesh for mesh, own in zip(meshes, shot.meshes) if not (own.is_garment or own.is_rider)]

    def points(self, times: Sequence[float]) -> list[Floats]:
        """Return positions of the garment at some frame times [m], each (V, 3)."""
        return [self.shot.garment_points(time) for time in times]
