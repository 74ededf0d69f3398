# SPDX-License-Identifier: Apache-2.0
"""What a finished task leaves beside its files, so that nobody bakes it again: bake.json."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path

from ... import __version__, work_record
from ...errors import SsilkError
from ...files import relative_path, sha256, split_location
from ...scene.plain import from_plain
from ...work_record import Hash, WorkRecord, request_key
from .inputs import InputHashes
from .request import INPUTS, BakeRequest
from .result import BakeResult
from .task import OF_ASSET, BakeTask

RECORD = "bake.json"
ANIMATION = "anim.usdc"  # of a garment's layers, by its path in their record
OF_FEW = ("sunk", "entered", "certificate", "loop")  # what records of shots without it do not name


@dataclass(frozen=True)
class RecordedInput:
    """An input of a finished task: its path relative to the folder of layers, with forward slashes; its SHA-256."""

    path: str
    sha256: str


@dataclass(frozen=True, kw_only=True)
class TaskRecord:
    """A finished task.

    Attributes:
        key: of everything that its files depend on (see `task_key`).
        files: SHA-256 of each file that it wrote, and of the layers `beneath`, by path relative to the record's
            folder.
        result: of its bake.
        inputs: what was in each of the request's `INPUTS`, and where it was.
        root: SkelRoot of the character, where one was named.
        level_of: the garment of its shot that it is a level of, where it is one.
        over: SHA-256 of the models that its own was trained over, by name.
    """

    key: str
    files: Mapping[str, str]
    result: BakeResult
    inputs: Mapping[str, RecordedInput]
    root: str | None
    level_of: str | None = None
    over: Mapping[str, str] = field(default_factory=dict)

    @property
    def wearer(self) -> tuple[str, str | None]:
        """The character that wears the garment in its shot: its motion and its SkelRoot."""
        return self.inputs["motion"].path, self.root

    @property
    def beneath(self) -> dict[str, str]:
        """SHA-256 of the layers that it was refined or certified over, by the names of their garments."""
        beside = {Path(name): digest for name, digest in self.files.items()}
        return {
            path.parts[1]: digest
            for path, digest in beside.items()
            if len(path.parts) == 3 and (path.parts[0], path.name) == ("..", ANIMATION)
        }


def task_key(task: BakeTask, contents: InputHashes) -> str:
    """Return a hash of all that decides what a task writes: where its inputs lie makes no difference.

    Args:
        contents: what the request's inputs hold.
    """
    options = asdict(task)
    for name in ("pinned", "replace", "over", *OF_ASSET):  # what it lies over is among the record's files
        del options[name]
    for name in INPUTS:
        del options["request"][name]
    for name in (
        "fabric",
        "material",
        "start_cloth",
    ):  # so that bakes in a model's own fabric stay as current as they were
        if not options["request"][name]:
            del options["request"][name]
    return request_key({"ssilk": __version__, "options": options}, [*asdict(contents).items()])


def inputs_of(request: BakeRequest, contents: InputHashes, folder: Path) -> dict[str, RecordedInput]:
    """Return the inputs of a request as a record in a folder of layers names them.

    Args:
        contents: what they hold.
    """
    paths = request.inputs.items()
    return {name: RecordedInput(portable(path, folder), getattr(contents, name)) for name, path in paths}


def portable(location: str, folder: Path) -> str:
    """Return "file[:/Prim]" relative to a folder, with forward slashes, so that both can move together.

    Where the two share nothing but the root, a hash tells the file from others of its name, and nothing tells where a
    studio keeps it.
    """
    file, prim = split_location(location)
    path = relative_path(file, folder)
    if path is None:
        path = f"{hashlib.sha256(os.path.abspath(file).encode()).hexdigest()[:8]}/{Path(file).name}"
    return f"{path}:{prim}" if prim else path


def write_record(folder: Path, record: TaskRecord) -> None:
    """Write a record into the folder of its files, last of all."""
    inputs = {name: asdict(each) for name, each in record.inputs.items()}
    detail = {**_portable(record.result), "inputs": inputs, "root": record.root}
    detail |= {"level_of": record.level_of} if record.level_of else {}
    detail |= {"over": dict(record.over)} if record.over else {}
    written = WorkRecord(key=record.key, files=dict(record.files), detail=detail)
    work_record.write_record(folder / RECORD, written)


def _portable(result: BakeResult) -> dict[str, object]:
    """Return a result without its folder, which can move, and without what it has no need of."""
    told = {**asdict(result), "path": result.path.name}
    return {name: value for name, value in told.items() if value or name not in OF_FEW}


def read_record(folder: Path) -> TaskRecord | None:
    """Return the record of a folder; None where none can be read, so that its task is done again."""
    try:
        found = work_record.read_record(folder / RECORD)
        if found is None:
            return None
        detail = {**found.detail, "path": folder / found.detail["path"]}
        told, root, level_of = detail.pop("inputs"), detail.pop("root"), detail.pop("level_of", None)
        over = {str(name): str(digest) for name, digest in detail.pop("over", {}).items()}
        inputs = {name: from_plain(RecordedInput, told[name]) for name in INPUTS}
        result = from_plain(BakeResult, detail)
        return TaskRecord(
            key=found.key, files=found.files, result=result, inputs=inputs, root=root, level_of=level_of, over=over
        )
    except (SsilkError, ValueError, TypeError, KeyError, AttributeError):
        return None


def current_record(folder: Path, key: str, hashed: Hash = sha256) -> TaskRecord | None:
    """Return the record of a task that is done: it has this key, and the files are as they were written.

    Args:
        hashed: gives the SHA-256 of a file.
    """
    record = read_record(folder)
    if record is None or record.key != key:
        return None
    return record if WorkRecord(key=key, files=record.files).is_done(folder, hashed) else None
