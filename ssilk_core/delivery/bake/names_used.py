# SPDX-License-Identifier: Apache-2.0
"""What the names in a folder of layers were used for: a name stays with its input."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import NoReturn

import numpy as np

from ...errors import fail
from ...files import replacing, split_location
from ...scene.plain import from_plain
from .inputs import InputContents, model_contents, stage_contents
from .record import RECORD, RecordedInput, TaskRecord, portable, read_record
from .task import OF_ASSET, BakeTask

USED = "used.json"
SAME_BODY = 1e-5  # [m], and in coordinates of a family, whose members are at one


@dataclass(frozen=True)
class GarmentUse:
    """What the name of a garment was used for.

    It lies beside the asset, so that a task need not look for the garment in all shots.

    Attributes:
        model: of the garment.
        root: the SkelRoot, where one was named.
        asset_version, asset_identifier: of the asset, where they were given.
        body: that it lies on, as `bodies.WornModel` tells it from others; None for the body that the model is of.
    """

    model: RecordedInput
    root: str | None
    asset_version: str | None = None
    asset_identifier: str | None = None
    body: tuple[float, ...] | None = None

    @classmethod
    def of(
        cls, task: BakeTask, model: RecordedInput, folder: Path, body: tuple[float, ...] | None = None
    ) -> GarmentUse:
        """Return what a task uses its garment's name for in a folder: what it does not say of the asset stays, as
        long as the model is the same."""
        before = _stated(_place(folder, task.garment))
        same = before is not None and before.model.sha256 == model.sha256
        told = {name: getattr(task, name) or (getattr(before, name) if same else None) for name in OF_ASSET}
        return cls(model, task.request.root, **told, body=body)

    def untold(self, folder: Path, garment: str) -> GarmentUse:
        """Return this with what the asset of a garment says of itself until it is written."""
        before = _stated(_place(folder, garment))
        kept = before if before is not None and before.model == self.model else GarmentUse(self.model, self.root)
        return replace(self, asset_version=kept.asset_version, asset_identifier=kept.asset_identifier)

    def says(self, task: BakeTask) -> bool:
        """Return whether the asset says of itself what a task asks for."""
        return all(getattr(task, name) in (None, getattr(self, name)) for name in OF_ASSET)


def write_use(folder: Path, garment: str, use: GarmentUse) -> None:
    """Write what a garment of a folder of layers is baked from, beside its asset; leave a file that says so alone.

    Raises:
        SsilkError: the file cannot be written.
    """
    if _stated(_place(folder, garment)) == use:
        return
    with replacing(_place(folder, garment)) as temporary:
        told = {name: value for name, value in asdict(use).items() if name != "body" or value is not None}
        temporary.write_text(json.dumps(told, indent=1, sort_keys=True) + "\n", encoding="utf-8")


def read_use(folder: Path, garment: str) -> GarmentUse | None:
    """Return what a garment was baked from; None where no file says so, and the name is free.

    Raises:
        SsilkError: the file is damaged.
    """
    path = _place(folder, garment)
    found = _stated(path)
    if found is None and path.exists():
        fail(
            str(path),
            f"it does not tell what the garment '{garment}' was baked from",
            "a name stays with its input",
            "name this garment with --garment-name, or use the name all the same with --replace",
        )
    return found


def need_same_body(folder: Path, task: BakeTask, use: GarmentUse) -> None:
    """Raise `SsilkError` where the name's asset lies on another body of its model's family: shots share it."""
    before = _stated(_place(folder, task.garment))
    if before is None or task.replace or before.model.sha256 != use.model.sha256:
        return
    if not _same_body(before.body, use.body):
        fail(
            str(folder),
            f"the garment '{task.garment}' was baked on another body of its model's family",
            "the shots of a name share one asset, which lies on one body",
            "name each body with --body-name, or use the name all the same with --replace",
        )


def _same_body(one: tuple[float, ...] | None, other: tuple[float, ...] | None) -> bool:
    """Return whether two bodies of a family are one, but for what rounding leaves on another machine."""
    if one is None or other is None:
        return one is other
    return len(one) == len(other) and bool(np.allclose(one, other, rtol=0, atol=SAME_BODY))


def says(folder: Path, task: BakeTask) -> bool:
    """Return whether the asset of a task says of itself what the task asks for; True where it asks for nothing."""
    if all(getattr(task, name) is None for name in OF_ASSET):
        return True
    use = _stated(_place(folder, task.garment))
    return use is not None and use.says(task)


def _stated(path: Path) -> GarmentUse | None:
    """Return what a file says; None where there is none, or it is damaged."""
    try:
        return from_plain(GarmentUse, json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError, RecursionError):
        return None


def forget_use(folder: Path, garment: str) -> None:
    """Free the name of a garment that is in no shot any more."""
    _place(folder, garment).unlink(missing_ok=True)


def _place(folder: Path, garment: str) -> Path:
    return folder / "assets" / garment / USED


def need_distinct_case(folder: Path, tasks: Iterable[BakeTask]) -> None:
    """Raise `SsilkError` where a shot or garment differs from one in a folder of layers by its case alone.

    Not every file system tells them apart.
    """
    tasks = list(tasks)
    for kind, home, names in (
        ("shot", folder / "shots", dict.fromkeys(task.shot for task in tasks)),
        ("garment", folder / "assets", dict.fromkeys(task.garment for task in tasks)),
    ):
        there = set(os.listdir(home)) if home.is_dir() else set()
        alike = {name.casefold(): name for name in sorted(there)}
        for name in names:
            if name not in there and (other := alike.get(name.casefold())):
                fail(
                    str(home),
                    f"there is a {kind} '{other}', one with '{name}' on some disks",
                    "files and folders are named by them",
                    f"name this {kind} '{other}', or otherwise, with --{kind}-name",
                )


class UsedNames:
    """The names of a folder of layers; what it reads of the folder is remembered.

    An input is the same as before if it has the same path or the same contents.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._shots: dict[str, dict[str, TaskRecord | None]] = {}
        self._garments: dict[str, GarmentUse | None] = {}

    def check(self, task: BakeTask) -> None:
        """Raise `SsilkError` where the names of a task were used for another motion, model or SkelRoot, where it
        would replace a garment of which no record tells what it was baked from, or where it asks for another version
        or identifier than the asset of the same model has."""
        request, shot = task.request, self._shot(task.shot)
        motions = [record.inputs["motion"] for record in shot.values() if record]
        for motion in motions:
            if not self._same(motion, request.motion, stage_contents):
                self._fail("shot", task.shot, motion.path, request.motion)
        own = shot.get(task.garment)
        used = GarmentUse(own.inputs["model"], own.root) if own else self._garment(task.garment)
        if task.garment in shot and not (used and motions):
            fail(
                str(self.folder / "shots" / task.shot / task.garment / RECORD),
                "it does not tell what this garment was baked from",
                "a name stays with its input",
                "name the shot with --shot-name, or replace the garment with --replace",
            )
        if used is None:
            return
        if not self._same(used.model, request.model, model_contents):
            self._fail("garment", task.garment, used.model.path, request.model)
        if used.root != request.root:
            roots = (f"{request.model}:{root}" if root else request.model for root in (used.root, request.root))
            self._fail("garment", task.garment, *roots)
        self._check_info(task)

    def _check_info(self, task: BakeTask) -> None:
        stated = _stated(_place(self.folder, task.garment))
        if stated is None:
            return
        for name, option in OF_ASSET.items():
            before, now = getattr(stated, name), getattr(task, name)
            if before and now and before != now and stated.model.sha256 == model_contents(task.request.model).digest:
                fail(
                    str(_place(self.folder, task.garment)),
                    f"the garment '{task.garment}' was baked with {option} '{before}', not '{now}'",
                    "all its shots share one asset",
                    f"leave {option} out, or give its asset another one with --replace",
                )

    def _shot(self, name: str) -> dict[str, TaskRecord | None]:
        """Return the records of the garments in a shot; None for one that is damaged."""
        if name not in self._shots:
            paths = sorted(self._records(name, "*"))
            self._shots[name] = {path.parent.name: read_record(path.parent) for path in paths}
        return self._shots[name]

    def _garment(self, name: str) -> GarmentUse | None:
        """Return what a garment was baked from in any of its shots, which share its asset."""
        if name not in self._garments:
            self._garments[name] = read_use(self.folder, name)
        return self._garments[name]

    def _records(self, shot: str, garment: str) -> Iterator[Path]:
        return self.folder.glob(f"shots/{shot}/{garment}/{RECORD}")

    def _same(self, before: RecordedInput, location: str, contents: Callable[[str], InputContents]) -> bool:
        """Return whether an input is the one that a record names."""
        if before.path == portable(location, self.folder):
            return True
        then, now = split_location(before.path), split_location(location)
        if not Path(now[0]).is_file():
            return True  # which is told when it is read
        if then[1] != now[1]:
            return False
        place = self.folder / then[0]
        return (place.is_file() and os.path.samefile(place, now[0])) or before.sha256 == contents(now[0]).digest

    def _fail(self, kind: str, name: str, before: str, now: str) -> NoReturn:
        fail(
            str(self.folder),
            f"the {kind} '{name}' was baked from '{before}', not from '{now}'",
            "a name stays with its input",
            f"name this {kind} with --{kind}-name, or use the name all the same with --replace",
        )
