# SPDX-License-Identifier: Apache-2.0
"""Many garments over many motions as a folder of layers, each task done once."""

from __future__ import annotations

import os
from collections.abc import Collection, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...errors import SsilkError, fail
from ...events import Message, Reporter, Result, Started, silent
from ...files import FileHashes, need_folder, remove_unfinished_in, replacing, sha256
from ...scene.riders import RiderJoints
from ...work_record import is_file
from ..targets import check_influences
from .asked import need_bodies
from .beneath import tell_left_out
from .certificate.certified import certified, proven
from .certificate.requirements import need_certifier
from .counted import state_rollout_counts
from .hiding import hidden_polygons_of
from .inputs import InputFiles, InputHashes, need_pinned
from .latents import solved
from .layered import inner_first, tell_layers, tell_other_layers, whole
from .levels import need_levels
from .load import LoadedGarment, load_garment
from .names_used import GarmentUse, UsedNames, need_distinct_case, need_same_body, says, write_use
from .origin import shot_metadata
from .record import (
    RECORD,
    TaskRecord,
    current_record,
    inputs_of,
    portable,
    read_record,
    task_key,
    write_record,
)
from .refinement import refined
from .request import BakeRequest
from .result import BakeResult
from .rollout import BakeRollout
from .shots import finished, write_shot_stage
from .task import BakeTask, has_possible_names, need_possible_names, plan_layers
from .verification import verify_file
from .write import result_of

if TYPE_CHECKING:
    from ssilk_usd.shots.layers import Layout
    from ssilk_usd.shots.layers_asset import WrittenAsset
    from ssilk_usd.writing.author import Asset


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
    if any(task.request.certify for task in tasks):
        need_certifier()
    if any(task.request.meets_beneath for task in tasks):
        tasks = inner_first(tasks)
    layers.need_names(tasks)
    if len({task.request.stage for task in tasks}) > 1:  # one is asked as it is baked
        need_bodies([task for task in tasks if again or not layers.is_done(task)])
    report(Started("bake", len(tasks), {"output": str(folder)}))
    try:
        for task in tasks:
            results.append(layers.bake(task, again=again, report=report, together=True))
            report(Result("bake", results[-1].figures("layer")))
    except BaseException:  # what is finished is in its shot, whatever stops the rest, which is what is told
        try:
            layers.write_stages(tasks[: len(results)], report)
        except SsilkError as error:
            report(Message(str(error), "warning"))
        raise
    layers.write_stages(tasks, report)
    for shot in dict.fromkeys(task.shot for task, result in zip(tasks, results) if not result.current):
        tell_layers(layers.path, shot, report)
    return results


class LayerFolder:
    """A folder of layers under way.

    The garment of the last task is kept: tasks of one garment that follow each other load it and write its asset
    once.

    Raises:
        SsilkError: `path` is a file.
    """

    def __init__(self, path: str | os.PathLike[str], inputs: InputFiles | None = None) -> None:
        self.path = Path(path)
        need_folder(self.path)
        self.inputs = inputs or InputFiles()
        self._files = FileHashes()
        self._checked: set[BakeTask] = set()  # tasks of which the names are known to be free
        self._loaded: LoadedGarment | None = None
        self._written: tuple[object, WrittenAsset] | None = None

    def layout(self, task: BakeTask) -> Layout:
        """Return where the files of a task lie."""
        from ssilk_usd.shots.layers import Layout

        return Layout(self.path, task.garment, task.shot)

    def garment(self, task: BakeTask) -> LoadedGarment:
        """Return the garment of a task, ready for any motion; raise `SsilkError` as `load_garment`."""
        request, kept = replace(task.request, motion="", range=None, handles=0), self._loaded
        held = kept is not None and all(map(self.inputs.still_there, (kept.model_held, kept.stage_held)))
        if kept is None or kept.request != request or not held:
            kept = self._loaded = load_garment(request)
        return kept

    def is_done(self, task: BakeTask) -> bool:
        """Return whether a task is done with its inputs as they are now, and its files are as they were written.

        Raises:
            SsilkError: an input is missing, cannot be read, or is not what the task's job was submitted with.
        """
        need_possible_names(task)
        found = self.inputs.hashes(task.request)
        if task.pinned:
            need_pinned(task.request, task.pinned, found)
        return self.is_written(task, found)

    def is_written(self, task: BakeTask, contents: InputHashes) -> bool:
        """Return whether a task is done with inputs that hold this, over the garments that it names alone, and its
        files are as they were written."""
        return self._done(task, contents, task.over) is not None

    def _done(self, task: BakeTask, contents: InputHashes, over: Collection[str]) -> TaskRecord | None:
        """Return the record of a task that is done, with an asset that says of itself what the task asks for.

        Args:
            over: names of the garments that it is to be refined or certified over.
        """
        if not (has_possible_names(task) and says(self.path, task) and self.layout(task).info.is_file()):
            return None
        record = current_record(self._home(task), task_key(task, contents), self._files.sha256)
        return record if record is not None and record.beneath.keys() == set(over) else None

    def need_names(self, tasks: Iterable[BakeTask], *, complete: bool = True) -> None:
        """Raise `SsilkError` where a name differs from one in the folder by case alone, or was used for another
        input, unless its task says so, and as `need_levels` does.

        It lists the folders of all shots and assets, so it is for a whole command; `bake` lists none.
        """
        tasks = list(tasks)
        need_distinct_case(self.path, tasks)
        need_levels(self.path, tasks, complete=complete)
        self._need_inputs(tasks)

    def _need_inputs(self, tasks: Iterable[BakeTask]) -> None:
        """Raise `SsilkError` where a name was used for another input, unless its task says so."""
        names = UsedNames(self.path)
        for task in tasks:
            if not task.replace and task not in self._checked:
                names.check(task)
                self._checked.add(task)

    def bake(
        self, task: BakeTask, *, again: bool = False, report: Reporter = silent, together: bool = False
    ) -> BakeResult:
        """Bake one garment in one shot, unless that is done already.

        Any number of processes may bake the same task at the same time: each writes the same files. The record's key
        is of what the inputs held while they were read.

        Args:
            together: refine and certify it over what it was trained over and lies finished in the shot; otherwise
                over what the task names alone, so that it does not depend on which tasks are done.

        Raises:
            SsilkError: an input is missing or bad, or not what the task's job was submitted with, a garment that it
                is refined or certified over is not finished, or a file cannot be written.
            VerificationError: the written layer is not what was computed; it is not kept.
        """
        need_possible_names(task)
        layout, home = self.layout(task), self._home(task)
        wanted = task.pinned or self.inputs.hashes(task.request)
        beneath = self._beneath(task, report) if task.request.meets_beneath and (together or task.over) else {}
        if missing := [name for name in task.over if name not in beneath]:
            found = f"{', '.join(missing)} beneath it is not finished in this shot"
            allowed = f"an outer garment is {task.request.made} over inner ones as their files have them"
            fail(f"{self.path}: {task.name}", found, allowed, "bake what lies beneath first, and this again")
        if not together:
            beneath = {name: path for name, path in beneath.items() if name in task.over}
        met = {os.path.relpath(path, home): sha256(path) for path in beneath.values()}
        record = None if again else self._done(task, wanted, beneath)
        if record is not None and met.items() <= record.files.items():
            return replace(record.result, current=True)
        need_levels(self.path, [task], complete=False)
        self._need_inputs([task])
        request = task.request
        garment = self.garment(task)
        rollout = garment.over(request.motion, range=request.range, handles=request.handles)
        if task.pinned:
            need_pinned(request, task.pinned, rollout.inputs)
        rollout.tell(report)
        check_influences(rollout.influences, request.target, request.model)
        key, inputs = task_key(task, rollout.inputs), inputs_of(request, rollout.inputs, self.path)
        use = GarmentUse.of(task, inputs["model"], self.path, garment.body)
        need_same_body(self.path, task, use)
        write_use(self.path, task.garment, use.untold(self.path, task.garment))  # no asset is without it
        asset = self._asset(task, garment, use, report)
        write_use(self.path, task.garment, use)  # the asset says so now
        result, files = _write_layer(layout, asset.asset, rollout, task, report, beneath)
        written = {os.path.relpath(path, home): digest for path, digest in (files | dict(asset.digests)).items()}
        written |= met
        record = TaskRecord(
            key=key, files=written, result=result, inputs=inputs, root=request.root, level_of=task.level_of,
            over=garment.over_models,
        )  # fmt: skip
        write_record(home, record)
        return result

    def _beneath(self, task: BakeTask, report: Reporter) -> dict[str, Path]:
        """Return the layers of garments that a task's was trained over, finished on the same character, by name.

        Where some of these are missing it is warned of, and of a damaged record that may be of one of them.
        """
        over, request = self.garment(task).over_models, task.request
        wearer = portable(request.motion, self.path), request.root
        there = finished(self.path, task.shot) if over else {}
        found = {
            name: self.layout(replace(task, garment=name)).animation
            for name, record in whole(there).items()
            if name != task.garment and record.wearer == wearer and record.inputs["model"].sha256 in over.values()
        }
        damaged = [name for name, record in there.items() if not record and name != task.garment]
        known = {record.inputs["model"].sha256 for name, record in whole(there).items() if name in found}
        missing = [name for name, digest in over.items() if digest not in known]
        if missing and not damaged and not task.over:
            tell_left_out(task.name, missing, request.made, report)
        elif missing and damaged:
            records = ", ".join(str(self._home(replace(task, garment=name)) / RECORD) for name in damaged)
            text = f"{records} is damaged, and nothing tells whether '{task.garment}' was trained over that garment"
            todo = f"it is {task.request.made} without; bake what is damaged again with --replace, then this"
            report(Message(f"{task.name}: {text}; {todo}", "warning"))
        for name in found:
            if self.layout(replace(task, garment=name)).points.is_file() and _is_refined_points(there[name]):
                text = f"the refined '{name}' is in its points, and this is {task.request.made} over its joints"
                report(Message(f"{task.name}: {text}; leave --refined-output out of both", "warning"))
        return found

    def _home(self, task: BakeTask) -> Path:
        """Return the folder of the files that a task alone writes."""
        return self.layout(task).animation.parent

    def _asset(self, task: BakeTask, garment: LoadedGarment, use: GarmentUse, report: Reporter) -> WrittenAsset:
        """Return the asset of a task, written unless the last task left the same."""
        layout = self.layout(task)
        asked = (garment, task.include_body, layout.asset, use)
        there = layout.info.is_file() and self._written is not None and self._is_there(self._written[1])
        if self._written is None or self._written[0] != asked or not there:
            self._written = (asked, _write_asset(layout, garment, task, use, report))
        return self._written[1]

    def _is_there(self, asset: WrittenAsset) -> bool:
        return all(is_file(path, digest, self._files.sha256) for path, digest in asset.digests)

    def write_stages(self, tasks: Sequence[BakeTask], report: Reporter = silent) -> None:
        """Write the stage of each shot of tasks, with all that is baked for it; warn of shots with an older asset.

        Raises:
            SsilkError: as `write_shot_stage` does; the stages of all other shots are written before.
        """
        layouts = [self.layout(task) for task in tasks]
        known: dict[str, set[str]] = {}
        for layout in layouts:
            known.setdefault(layout.garment, set()).add(layout.shot)
        needed: dict[str, set[str]] = {}
        for layout in layouts:
            needed.setdefault(layout.shot, set()).add(layout.garment)
        replaced: dict[str, list[str]] = {}
        for task in tasks:
            if task.replace:
                replaced.setdefault(task.shot, []).append(task.garment)
        errors: list[SsilkError] = []
        for shot, garments in needed.items():
            try:
                write_shot_stage(self.path, shot, report, needed=garments, replaced=replaced.get(shot, ()))
            except SsilkError as error:
                errors.append(error)
            tell_other_layers(self.path, shot, report)
        for layout in {layout.garment: layout for layout in layouts}.values():
            outdated = list(_outdated_shots(layout, known[layout.garment]))
            if outdated:
                report(Message(
                    f"{layout.asset}: {len(outdated)} shots were baked with the asset as it was before "
                    f"({', '.join(outdated[:3])}); bake them again", "warning"))  # fmt: skip
        if errors:
            raise _as_one(errors, len(needed))

    def remove_unfinished(self, tasks: Sequence[BakeTask]) -> None:
        """Remove what processes that have ended left half written."""
        layouts = [self.layout(task) for task in tasks if has_possible_names(task)]
        paths = (path for each in layouts for path in (each.asset, each.stage, each.animation))
        for folder in dict.fromkeys(path.parent for path in paths):
            remove_unfinished_in(folder)


def _is_refined_points(record: TaskRecord | None) -> bool:
    """Return whether a garment was refined, and its joints are the network's."""
    return record is not None and record.result.refinement is not None and record.result.refinement.shapes is None


def _as_one(errors: Sequence[SsilkError], shots: int) -> SsilkError:
    """Return the error of shots whose stages could not be written."""
    if len(errors) == 1:
        return errors[0]
    return SsilkError(f"{len(errors)} of {shots} shots have no current stage; the first: {errors[0]}")


def _write_asset(
    layout: Layout, garment: LoadedGarment, task: BakeTask, use: GarmentUse, report: Reporter
) -> WrittenAsset:
    """Write the asset of a task where it is not there already; warn of changes that layers above may rely on."""
    from ssilk_usd.shots import layers_asset

    version, identifier = use.asset_version or garment.info.version, use.asset_identifier or ""
    riders = RiderJoints(garment.deformer, garment.riders, task.request.receiver.influences)
    written = layers_asset.write_asset(
        layout,
        riders.deformer,
        garment.units,
        riders=riders,
        include_body=task.include_body,
        record=garment.record,
        info=replace(garment.info, version=version, identifier=identifier),
        lean=task.request.receiver.lean,
    )
    for change in written.changes:
        report(Message(f"{layout.asset}: {change}; check the layers that override it", "warning"))
    if written.asset.left_out:
        report(Message(f"{layout.asset}: {written.asset.left_out}", "warning"))
    return written


def _write_layer(
    layout: Layout, asset: Asset, rollout: BakeRollout, task: BakeTask, report: Reporter, beneath: Mapping[str, Path]
) -> tuple[BakeResult, dict[Path, str]]:
    """Write and verify what moves; return the result, and SHA-256 of what was written, by its path.

    Args:
        beneath: layers of garments that it is refined and certified over, by name.
    """
    from ssilk_usd.shots import layers_animation

    rollout = refined(solved(rollout, report), report, add_shapes=True, beneath=beneath)
    rollout = certified(rollout, report, beneath)
    hidden = hidden_polygons_of(rollout, report)
    riders = rollout.rider_joints()
    if riders and rollout.request.writes_points:
        text = "what rides on the garment follows the joints, also where the variant 'points' is selected"
        report(Message(f"{layout.animation}: {text}", "warning"))
    common: dict[str, Any] = {
        "units": rollout.units,
        "start": rollout.start,
        "samples_per_frame": task.request.samples_per_frame,
        "lean": task.request.receiver.lean,
    }
    digests: dict[Path, str] = {}
    with replacing(layout.animation) as unverified:
        while True:
            summary = layers_animation.write_animation(
                layout,
                asset,
                riders.deformer,
                rollout.motion,
                riders.poses(rollout.motion, rollout.poses()),
                **common,
                riders=riders,
                hidden=rollout.hidden,
                hidden_polygons=hidden,
                provenance=shot_metadata(rollout, layout.animation),
                path=unverified,
                points=task.points,
                record=rollout.played,
            )
            again = proven(rollout, unverified, report)
            if again is None:
                break
            rollout, riders, hidden = again, again.rider_joints(), hidden_polygons_of(again, report)
        if task.points:  # not before: what the file shows may have moved the garment again
            digests[layout.points] = layers_animation.write_points(
                layout, asset, rollout.points(), rollout.deformer, rollout.motion, **common
            )
        counts = state_rollout_counts(unverified, rollout)
        verification = verify_file(rollout, unverified, report) if task.verify else None
        digests[layout.animation] = sha256(unverified)  # not later: another process may replace the file
    rollout.warn(report)
    return result_of(rollout, layout.animation, summary, counts, verification, hidden), digests


def _outdated_shots(layout: Layout, current: Container[str]) -> Iterator[str]:
    """Yield the shots, besides the `current` ones, whose record has another asset of this garment than is there."""
    digest = sha256(layout.geometry) if layout.geometry.is_file() else None
    for path in sorted(layout.folder.glob(f"shots/*/{layout.garment}/{RECORD}")):
        shot = path.parent.parent.name
        if digest is None or shot in current:
            continue
        record, name = read_record(path.parent), os.path.relpath(layout.geometry, path.parent)
        if record and record.files.get(name) != digest:
            yield shot
