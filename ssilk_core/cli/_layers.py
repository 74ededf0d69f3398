# SPDX-License-Identifier: Apache-2.0
"""What 'bake' and 'task' share: one garment in one shot as layers, done once."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import fail
from ..events import Message, Reporter, silent
from ..farm.record import NAME, TaskRecord, is_current, read_record, task_key, write_record
from ..farm.tasks import BakeTask
from ..files import remove_unfinished, replacing, sha256
from ..targets import need_influences
from ._baking import Bake, BakeRequest, Dressed, dressed

if TYPE_CHECKING:
    from ssilk_usd.author import Asset
    from ssilk_usd.layers import Layout


class Wardrobe:
    """Garments on their characters, the last one kept: tasks of one model that follow each other load it once, and
    write its asset once."""

    def __init__(self) -> None:
        self.open = lru_cache(maxsize=1)(dressed)
        self.written: tuple[object, Asset] | None = None

    def dressed(self, task: BakeTask) -> Dressed:
        """Return the garment of a task, ready for any motion."""
        return self.open(replace(BakeRequest.of(task), motion=""))

    def asset(self, task: BakeTask, layout: Layout, report: Reporter) -> Asset:
        """Return the asset of a task, which is there as `_write_asset` leaves it."""
        garment = self.dressed(task)
        asked = (garment, task.body, layout.asset)
        if self.written is None or self.written[0] != (asked, _digests(layout)):
            asset = _write_asset(layout, garment, task, report)
            self.written = ((asked, _digests(layout)), asset)
        return self.written[1]


def _digests(layout: Layout) -> list[str]:
    return [sha256(path) for path in (layout.asset, layout.geometry) if path.is_file()]


def layout_of(task: BakeTask, folder: Path) -> Layout:
    """Return where the files of a task lie."""
    from ssilk_usd.layers import Layout

    return Layout(folder, task.garment, task.shot)


def key_of(task: BakeTask) -> str:
    """Return the key of a task, from what its inputs hold now.

    Raises:
        SsilkError: an input is missing or cannot be read.
    """
    from ssilk_usd.read_stage import content_hash, split_location

    if not Path(task.model).is_file():
        fail(task.model, "there is no such model file", "a file of 'ssilk train' is needed")
    contents = {
        "model": sha256(task.model),
        "stage": content_hash(task.stage),
        "motion": content_hash(split_location(task.motion)[0]),
    }
    return task_key(task, contents)


def is_done(task: BakeTask, folder: Path) -> bool:
    """Return whether a task is done with the inputs as they are now, and its files are as they were written."""
    return is_current(layout_of(task, folder).animation.parent, key_of(task))


def bake_task(
    task: BakeTask, folder: Path, wardrobe: Wardrobe, report: Reporter, *, again: bool = False
) -> dict[str, object]:
    """Bake one garment in one shot, unless that is done already; return figures for people.

    Raises:
        SsilkError: an input is missing or bad, or a file cannot be written.
        VerificationError: the written layer is not what was computed; it is not kept.
    """
    layout, key = layout_of(task, folder), key_of(task)
    home = layout.animation.parent
    if not again and is_current(home, key):
        return {"layer": str(layout.animation), "current": True}
    for path in _own(layout):
        remove_unfinished(path)
    bake = wardrobe.dressed(task).over(task.motion)
    need_influences(bake.influences, task.target, task.model)
    asset = wardrobe.asset(task, layout, report)
    detail = _write_animation(layout, asset, bake, task, report)
    files = [layout.animation, layout.asset, layout.geometry, *([layout.points] if task.points else [])]
    written = {os.path.relpath(path, home): sha256(path) for path in files}
    write_record(home, TaskRecord(key=key, files=written, detail=detail))
    return {"layer": str(layout.animation), **detail}


def _write_asset(layout: Layout, garment: Dressed, task: BakeTask, report: Reporter) -> Asset:
    """Write the asset of a task where it is not there already; warn of what layers above relied on."""
    from ssilk_usd import layers

    written = layers.write_asset(
        layout, garment.deformer, garment.units, include_body=task.body, record=garment.record
    )
    for change in written.changes:
        report(Message(f"{layout.asset}: {change}; check the layers that override it", "warning"))
    return written.asset


def _write_animation(layout: Layout, asset: Asset, bake: Bake, task: BakeTask, report: Reporter) -> dict[str, object]:
    """Write and prove what moves; return figures."""
    from ssilk_usd import layers

    refined = bake.refine(report)
    common: dict[str, Any] = {
        "units": bake.units,
        "start": bake.start,
        "samples_per_frame": task.samples,
        "lean": bake.target.lean,
    }
    if task.points:
        layers.write_points(layout, asset, bake.points(silent), bake.deformer, bake.motion, **common)
    with replacing(layout.animation) as unproven:
        summary = layers.write_animation(
            layout,
            asset,
            bake.deformer,
            bake.motion,
            bake.poses(),
            **common,
            hidden=bake.hidden,
            provenance=bake.carried(layout.animation),
            path=unproven,
            points=task.points,
        )
        proof = bake.verify(unproven, report) if task.verify else {}
    return {
        "frames": summary.frame_count,
        "fps": summary.fps,
        "bytes": layout.animation.stat().st_size,
        **refined,
        **proof,
        **bake.warn(report),
    }


def write_stages(tasks: Sequence[BakeTask], folder: Path, report: Reporter) -> None:
    """Write the stage of each shot of tasks that are done; name shots that an asset outgrew."""
    from ssilk_usd.layers import write_stage

    layouts = [layout_of(task, folder) for task in tasks]
    shots: dict[str, list[Layout]] = {}
    for layout in layouts:
        shots.setdefault(layout.shot, []).append(layout)
    for garments in shots.values():
        write_stage(garments)
    for layout in {layout.garment: layout for layout in layouts}.values():
        outgrown = list(_outgrown(layout))
        if outgrown:
            report(Message(
                f"{layout.asset}: {len(outgrown)} shots were baked with the asset as it was before "
                f"({', '.join(outgrown[:3])}); bake them again", "warning"))  # fmt: skip


def clear(tasks: Sequence[BakeTask], folder: Path) -> None:
    """Remove what killed processes left half-written of tasks that nobody works on any more."""
    layouts = [layout_of(task, folder) for task in tasks]
    shared = {path for layout in layouts for path in (layout.asset, layout.geometry, layout.stage)}
    for path in shared.union(*(_own(layout) for layout in layouts)):
        remove_unfinished(path)


def _own(layout: Layout) -> tuple[Path, ...]:
    """Return the files that one task alone writes."""
    return (layout.animation, layout.points, layout.animation.with_name(NAME))


def _outgrown(layout: Layout) -> Iterator[str]:
    """Yield the shots whose record has another asset of this garment than is there now."""
    for path in sorted(layout.folder.glob(f"shots/*/{layout.garment}/{NAME}")):
        record, name = read_record(path.parent), os.path.relpath(layout.geometry, path.parent)
        if record and layout.geometry.is_file() and record.files.get(name) != sha256(layout.geometry):
            yield path.parent.parent.name
