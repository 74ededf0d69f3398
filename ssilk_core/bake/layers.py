# SPDX-License-Identifier: Apache-2.0
"""Many garments over many motions as a folder of layers, each task done once."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import fail
from ..events import Message, Reporter, Result, Started, silent
from ..files import remove_unfinished, replacing, sha256
from ..targets import check_influences
from .hiding import covered_polygons
from .load import LoadedGarment, load_garment
from .names_used import UsedNames
from .origin import shot_metadata
from .record import RECORD, TaskRecord, current_record, inputs_of, read_record, task_key, write_record
from .refinement import refined
from .request import BakeRequest
from .result import BakeResult
from .rollout import BakeRollout
from .shots import write_shot_stage
from .skin import SkinMeter
from .task import BakeTask, plan_layers
from .verification import verify_file
from .write import result_of

if TYPE_CHECKING:
    from ssilk_usd.author import Asset
    from ssilk_usd.layers import Layout


def bake_layers(
    requests: Iterable[BakeRequest],
    folder: str | os.PathLike[str],
    *,
    include_body: bool = True,
    points: bool = False,
    verify: bool = True,
    again: bool = False,
    replace_names: bool = False,
    report: Reporter = silent,
) -> list[BakeResult]:
    """Bake garments over motions as layers: an asset for each garment, a small layer for each garment in each shot,
    and a stage for each shot.

    Args:
        folder: made where it is not there; its layout is in docs/pipeline.md.
        include_body: write each character's body meshes; a shot shows those of one of its garments.
        points: write point caches as well.
        verify: re-skin each layer by UsdSkel and compare it with the decoder's own vertices.
        again: bake what is there and current, too.
        replace_names: bake even where the name of a garment or a shot was used for another input before.
        report: takes events.

    Returns:
        A result for each request, those of one garment together.

    Raises:
        SsilkError: an input is missing or does not fit, two garments or two shots would have one name, a name was
            used for another input, or a file cannot be written; what was finished before stays.
        VerificationError: a layer is not what was computed; it is not kept.
    """
    tasks = plan_layers(
        requests, include_body=include_body, points=points, verify=verify, replace_names=replace_names
    )
    layers, results = LayerFolder(folder), []
    layers.need_names(tasks)
    report(Started("bake", len(tasks), {"output": str(folder)}))
    try:
        for task in tasks:
            results.append(layers.bake(task, again=again, report=report))
            report(Result("bake", results[-1].figures("layer")))
    finally:  # what is finished is in its shot, whatever stops the rest
        layers.write_stages(tasks[: len(results)], report)
    return results


class LayerFolder:
    """A folder of layers under way.

    The garment of the last task is kept: tasks of one garment that follow each other load it and write its asset
    once.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._load = lru_cache(maxsize=1)(load_garment)
        self._written: tuple[object, Asset] | None = None

    def layout(self, task: BakeTask) -> Layout:
        """Return where the files of a task lie."""
        from ssilk_usd.layers import Layout

        return Layout(self.path, task.garment, task.shot)

    def garment(self, task: BakeTask) -> LoadedGarment:
        """Return the garment of a task, ready for any motion; raise `SsilkError` as `load_garment`."""
        return self._load(replace(task.request, motion="", range=None, handles=0))

    def is_done(self, task: BakeTask) -> bool:
        """Return whether a task is done with its inputs as they are now, and its files are as they were written.

        Raises:
            SsilkError: an input is missing or cannot be read.
        """
        return current_record(self._home(task), key_of(task)) is not None

    def need_names(self, tasks: Iterable[BakeTask]) -> None:
        """Raise `SsilkError` where a name was used for another input, unless its task says so."""
        names = UsedNames(self.path)
        for task in tasks:
            if not task.replace:
                names.check(task)

    def bake(self, task: BakeTask, *, again: bool = False, report: Reporter = silent) -> BakeResult:
        """Bake one garment in one shot, unless that is done already.

        Raises:
            SsilkError: an input is missing or bad, or a file cannot be written.
            VerificationError: the written layer is not what was computed; it is not kept.
        """
        layout, contents, home = self.layout(task), contents_of(task), self._home(task)
        key = task_key(task, contents)
        if not again and (record := current_record(home, key)):
            return replace(record.result, current=True)
        self.need_names([task])
        for path in _own_files(layout):
            remove_unfinished(path)
        request = task.request
        rollout = self.garment(task).over(request.motion, range=request.range, handles=request.handles)
        rollout.tell(report)
        check_influences(rollout.influences, task.request.target, task.request.model)
        asset = self._asset(task, layout, report)
        result = _write_layer(layout, asset, rollout, task, report)
        files = [layout.animation, layout.asset, layout.geometry, *([layout.points] if task.points else [])]
        written = {os.path.relpath(path, home): sha256(path) for path in files}
        inputs = inputs_of(task.request, contents, self.path)
        write_record(home, TaskRecord(key=key, files=written, result=result, inputs=inputs, root=task.request.root))
        return result

    def _home(self, task: BakeTask) -> Path:
        """Return the folder of the files that a task alone writes."""
        return self.layout(task).animation.parent

    def _asset(self, task: BakeTask, layout: Layout, report: Reporter) -> Asset:
        """Return the asset of a task, written unless the last task left the same."""
        garment = self.garment(task)
        asked = (garment, task.include_body, layout.asset)
        if self._written is None or self._written[0] != (asked, _digests(layout)):
            asset = _write_asset(layout, garment, task, report)
            self._written = ((asked, _digests(layout)), asset)
        return self._written[1]

    def write_stages(self, tasks: Sequence[BakeTask], report: Reporter = silent) -> None:
        """Write the stage of each shot of tasks, with all that is baked for it; warn of shots with an older asset."""
        layouts = [self.layout(task) for task in tasks]
        for shot in dict.fromkeys(task.shot for task in tasks):
            write_shot_stage(self.path, shot, report)
        for layout in {layout.garment: layout for layout in layouts}.values():
            outdated = list(_outdated_shots(layout))
            if outdated:
                report(Message(
                    f"{layout.asset}: {len(outdated)} shots were baked with the asset as it was before "
                    f"({', '.join(outdated[:3])}); bake them again", "warning"))  # fmt: skip

    def remove_unfinished(self, tasks: Sequence[BakeTask]) -> None:
        """Remove what killed processes left half written of tasks that nobody works on any more."""
        layouts = [self.layout(task) for task in tasks]
        shared = {path for layout in layouts for path in (layout.asset, layout.geometry, layout.stage)}
        for path in shared.union(*(_own_files(layout) for layout in layouts)):
            remove_unfinished(path)


def key_of(task: BakeTask) -> str:
    """Return the key of a task, from what its inputs hold now.

    Raises:
        SsilkError: an input is missing or cannot be read.
    """
    return task_key(task, contents_of(task))


def contents_of(task: BakeTask) -> dict[str, str]:
    """Return a hash of what each input of a task holds now.

    Raises:
        SsilkError: an input is missing or cannot be read.
    """
    from ssilk_usd.read_stage import content_hash, split_location

    request = task.request
    if not Path(request.model).is_file():
        fail(request.model, "there is no such model file", "a file of 'ssilk train' is needed")
    return {
        "model": sha256(request.model),
        "stage": content_hash(request.stage),
        "motion": content_hash(split_location(request.motion)[0]),
    }


def _digests(layout: Layout) -> list[str]:
    return [sha256(path) for path in (layout.asset, layout.geometry) if path.is_file()]


def _write_asset(layout: Layout, garment: LoadedGarment, task: BakeTask, report: Reporter) -> Asset:
    """Write the asset of a task where it is not there already; warn of changes that layers above may rely on."""
    from ssilk_usd import layers

    written = layers.write_asset(
        layout, garment.deformer, garment.units, include_body=task.include_body, record=garment.record
    )
    for change in written.changes:
        report(Message(f"{layout.asset}: {change}; check the layers that override it", "warning"))
    return written.asset


def _write_layer(layout: Layout, asset: Asset, rollout: BakeRollout, task: BakeTask, report: Reporter) -> BakeResult:
    """Write and verify what moves."""
    from ssilk_usd import layers

    rollout = refined(rollout, report)
    hidden = covered_polygons(rollout, report) if task.request.hide_covered else None
    skin = SkinMeter(rollout)
    common: dict[str, Any] = {
        "units": rollout.units,
        "start": rollout.start,
        "samples_per_frame": task.request.samples_per_frame,
        "lean": task.request.receiver.lean,
    }
    if task.points:
        layers.write_points(layout, asset, rollout.points(), rollout.deformer, rollout.motion, **common)
    with replacing(layout.animation) as unverified:
        summary = layers.write_animation(
            layout,
            asset,
            rollout.deformer,
            rollout.motion,
            skin.poses(),
            **common,
            hidden=rollout.hidden,
            hidden_polygons=hidden,
            provenance=shot_metadata(rollout, layout.animation, skin.stated),
            path=unverified,
            points=task.points,
        )
        verification = verify_file(rollout, unverified, report) if task.verify else None
    rollout.warn(report)
    return result_of(skin, layout.animation, summary, verification, hidden)


def _own_files(layout: Layout) -> tuple[Path, ...]:
    """Return the files that one task alone writes."""
    return (layout.animation, layout.points, layout.animation.with_name(RECORD))


def _outdated_shots(layout: Layout) -> Iterator[str]:
    """Yield the shots whose record has another asset of this garment than is there now."""
    for path in sorted(layout.folder.glob(f"shots/*/{layout.garment}/{RECORD}")):
        record, name = read_record(path.parent), os.path.relpath(layout.geometry, path.parent)
        if record and layout.geometry.is_file() and record.files.get(name) != sha256(layout.geometry):
            yield path.parent.parent.name
