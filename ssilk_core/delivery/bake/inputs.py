# SPDX-License-Identifier: Apache-2.0
"""What the inputs of a bake hold: hashes of the bytes that were read, not of those that lie there later."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TypeVar

from ...errors import SsilkError, fail
from ...files import FileHashes, relative_path, sha256, split_body, split_location
from ...scene.shape_weights import parse_shapes, shapes_text
from .request import INPUTS, BakeRequest

T = TypeVar("T")
TRIES = 3  # of reading files that change meanwhile


@dataclass(frozen=True, kw_only=True)
class InputHashes:
    """SHA-256 of what each input of a request holds (see `InputContents.digest`); empty if it could not be read."""

    model: str
    stage: str
    motion: str


@dataclass(frozen=True)
class InputContents:
    """What an input holds.

    Attributes:
        files: path and SHA-256 of each file that it consists of, the one that a request names first.
        shapes: weights of the stage's shapes that make the body, as `shapes_text` writes them; "" for its own.
    """

    files: tuple[tuple[str, str], ...]
    shapes: str = ""

    @property
    def first(self) -> str:
        """SHA-256 of the file that a request names."""
        return self.files[0][1]

    @property
    def digest(self) -> str:
        """SHA-256 of all files, of where they lie beside each other, and of shapes; of the file where it is one."""
        if self.shapes:
            whole = replace(self, shapes="").digest
            return hashlib.sha256(json.dumps([whole, self.shapes]).encode()).hexdigest()
        if len(self.files) == 1:
            return self.first
        home = Path(self.files[0][0]).parent
        # By its name alone where the two share nothing, as on other machines.
        parts = sorted((relative_path(path, home) or Path(path).name, digest) for path, digest in self.files)
        return hashlib.sha256(json.dumps(parts).encode()).hexdigest()

    def still_there(self, hashed: Callable[[str], str] = sha256) -> bool:
        """Return whether the files hold the same as before."""
        try:
            return all(hashed(path) == digest for path, digest in self.files)
        except OSError:
            return False


def model_contents(model: str, hashed: Callable[[str], str] = sha256) -> InputContents:
    """Return what a model file holds; raise `SsilkError` where there is none."""
    if not Path(model).is_file():
        fail(model, "there is no such model file", "a file of 'ssilk train' is needed")
    return _hashed([model], hashed)


def stage_contents(location: str, hashed: Callable[[str], str] = sha256) -> InputContents:
    """Return what a stage with all its layers and value clips holds.

    Args:
        location: its file, with or without shapes and the path of a prim.

    Raises:
        SsilkError: it cannot be read.
    """
    from ssilk_usd.opening.stage import used_files

    return replace(_hashed(used_files(split_location(location)[0]), hashed), shapes=shapes_of(location))


def shapes_of(location: str) -> str:
    """Return the weights of shapes in a location as they are compared; "" where it has none."""
    shapes = split_body(split_location(location)[0])[1]
    return shapes_text(parse_shapes(location, shapes)) if shapes else ""


def _hashed(paths: Iterable[str], hashed: Callable[[str], str]) -> InputContents:
    try:
        return InputContents(tuple((path, hashed(path)) for path in paths))
    except OSError as error:
        return fail(
            str(error.filename), f"it cannot be read ({error.strerror})", "every input must stay in its place"
        )


def read_unchanged(contents: Callable[[], InputContents], read: Callable[[], T]) -> tuple[T, InputContents]:
    """Return what `read` makes of an input, and what the input held all the while.

    USD opens layers by itself and reads their values when they are asked for. Files are therefore hashed before they
    are opened, and again after the last value was read; where the two differ, everything is read again.

    Raises:
        SsilkError: as `contents` and `read` do, or the files change each time.
    """
    for _ in range(TRIES):
        before = contents()
        try:
            made = read()
        except SsilkError:
            if before.still_there():
                raise
            continue
        if before.still_there():
            return made, before
    return fail(before.files[0][0], "it changes while it is read", "inputs are files that stay as they are",
         "write them under another name and rename them")  # fmt: skip


class InputFiles:
    """The inputs of many tasks as they are now, each file read again only where it may have changed.

    Args:
        known: what inputs held before, by their locations: where they still do, USD need not open them.
    """

    def __init__(self, known: Mapping[str, InputContents] = MappingProxyType({})) -> None:
        self._hashed = FileHashes().sha256
        self._known = dict(known)

    def hashes(self, request: BakeRequest) -> InputHashes:
        """Return what the inputs of a request hold; raise `SsilkError` where one cannot be read."""
        return InputHashes(**{name: self.digest(name, path) for name, path in request.inputs.items()})

    def digest(self, name: str, path: str) -> str:
        """Return what an input holds.

        Args:
            name: of the input, one of `INPUTS`.

        Raises:
            SsilkError: it cannot be read.
        """
        return self.contents(name, path).digest

    def contents(self, name: str, path: str) -> InputContents:
        """Return what an input holds; arguments and errors are those of `digest`."""
        known = self._known.get(path)
        if known is None or not self.still_there(known):
            find = model_contents if name == "model" else stage_contents
            known = self._known[path] = find(path, self._hashed)
        return known

    def still_there(self, contents: InputContents) -> bool:
        """Return whether the files of an input hold the same as before."""
        return contents.still_there(self._hashed)


def need_pinned(request: BakeRequest, pinned: InputHashes, found: InputHashes) -> None:
    """Raise `SsilkError` where an input is not what a job was submitted with."""
    for name in INPUTS:
        if not getattr(pinned, name):
            fail(
                getattr(request, name),
                f"the {name} could not be read when the job was submitted",
                "a job bakes what its inputs held then",
                "submit the job again",
            )
        if getattr(pinned, name) != getattr(found, name):
            fail(
                getattr(request, name),
                f"the {name} has changed since the job was submitted",
                "a job bakes what its inputs held then",
                "restore it, or submit the job again",
            )
