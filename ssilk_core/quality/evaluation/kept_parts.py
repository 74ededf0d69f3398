# SPDX-License-Identifier: Apache-2.0
"""What a long measurement has found so far, beside its file of rows: a run that is cut goes on from there.

Rows are figures for people, and one may take an hour. Parts are what rows are made of, bit for bit: records of takes,
states of a simulation. They lie in one file of tensors (safetensors), which goes when the last row is measured.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
import torch
from torch import Tensor

from ...errors import fail
from ...events import Message, Reporter, finite, silent
from ...files import replacing

EVERY = 5.0  # [s] between two writings, at least: so much work is lost in a cut, and one part
KEY = "ssilk_inputs"  # of the file's metadata: a hash of what its parts depend on
FIELD = ":"  # between the name of a part and that of a field of it

T = TypeVar("T")


class PartsFile:
    """The file of all parts of a measurement.

    Args:
        path: of the file; None keeps nothing.
        inputs: as `KeptRows` has them. A file of others is begun anew.

    Raises:
        SsilkError: the file is none of parts.
    """

    def __init__(self, path: Path | None, inputs: Mapping[str, Any], report: Reporter = silent) -> None:
        self.path, self._key = path, hashlib.sha256(json.dumps(finite(dict(inputs))).encode()).hexdigest()
        self.parts: dict[str, dict[str, Tensor]] = {}
        self._written, self._changed = time.monotonic(), False
        if path is not None and path.exists():
            self._read(path, report)

    @property
    def due(self) -> bool:
        """Whether it is time to write."""
        return self.path is not None and time.monotonic() - self._written >= EVERY

    def changed(self) -> None:
        """Write the file if it is time."""
        self._changed = True
        if self.due:
            self.write()

    def write(self) -> None:
        """Write what has changed since the last time."""
        from safetensors.torch import save_file

        if self.path is None or not self._changed:
            return
        tensors = {f"{name}{FIELD}{at}": value for name, part in self.parts.items() for at, value in part.items()}
        with replacing(self.path) as temporary:
            save_file(tensors, temporary, metadata={KEY: self._key})
        self._written, self._changed = time.monotonic(), False

    def remove(self) -> None:
        """Forget all parts, and remove the file."""
        self.parts, self._changed = {}, False
        if self.path is not None:
            self.path.unlink(missing_ok=True)

    def _read(self, path: Path, report: Reporter) -> None:
        from safetensors import SafetensorError, safe_open

        try:
            with safe_open(path, framework="pt") as file:
                key = (file.metadata() or {})[KEY]
                names = file.keys() if key == self._key else None
                tensors = None if names is None else {name: file.get_tensor(name) for name in names}
        except (OSError, SafetensorError, KeyError) as error:
            found = f"not what a measurement keeps ({type(error).__name__}: {error})"
            fail(str(path), found, "only a file of its own is replaced", "move it away, or name another output")
        if tensors is None:
            report(Message(f"{path}: begun anew, its parts are of other inputs", "warning"))
            return
        for name, value in tensors.items():
            part, _, at = name.rpartition(FIELD)
            self.parts.setdefault(part, {})[at] = value


@dataclass(frozen=True)
class KeptParts:
    """Parts of a measurement by name: dataclasses of tensors, arrays, numbers, and lists and dictionaries of these.

    Attributes:
        file: that holds them; None keeps nothing.
        within: what their names begin with in the file.
    """

    file: PartsFile | None = None
    within: tuple[object, ...] = ()

    def of(self, *within: object) -> KeptParts:
        """Return those whose names begin so."""
        return KeptParts(self.file, (*self.within, *within))

    @property
    def due(self) -> bool:
        """Whether it is time to write: what costs time to put is put then."""
        return self.file is not None and self.file.due

    def __contains__(self, name: object) -> bool:
        return self.file is not None and self._named(name) in self.file.parts

    def get(self, name: object, kind: type[T], device: torch.device | str = "cpu") -> T | None:
        """Return a part, with its tensors on a device; None where it is not known.

        Raises:
            SsilkError: it is no such dataclass, because another version wrote it.
        """
        if self.file is None or name not in self:
            return None
        try:
            found: T = _rebuilt(kind, self.file.parts[self._named(name)], "", torch.device(device))
        except KeyError as error:
            fail(str(self.file.path), f"{name} lacks {error}", "parts of this version are needed", "delete the file")
        return found

    def put(self, name: object, part: object) -> None:
        """Keep a part; it is in the file when that is written next."""
        if self.file is not None and self.file.path is not None:
            self.file.parts[self._named(name)] = _flattened(part, "")
            self.file.changed()

    def _named(self, name: object) -> str:
        return json.dumps([*self.within, name])


NOTHING_KEPT = KeptParts()


def _flattened(value: Any, at: str) -> dict[str, Tensor]:
    """Return the tensors of a value by their places in it; numbers are tensors without a dimension."""
    if value is None:
        return {}
    if isinstance(value, Tensor | np.ndarray | bool | int | float):
        kind = torch.float64 if isinstance(value, float) else None
        assert FIELD not in at
        return {at: torch.as_tensor(value, dtype=kind).detach().cpu().clone(memory_format=torch.contiguous_format)}
    if isinstance(value, Sequence):
        items: dict[str, Any] = {str(number): item for number, item in enumerate(value)}
        found = {at: torch.tensor(len(value))}
    else:
        items, found = dict(value) if isinstance(value, Mapping) else vars(value), {}
    for name, item in items.items():
        found |= _flattened(item, f"{at}.{name}" if at else name)
    return found


def _rebuilt(kind: Any, tensors: Mapping[str, Tensor], at: str, device: torch.device) -> Any:
    """Return what `_flattened` made these tensors of, as a type says; raise `KeyError` where one is missing."""
    below = f"{at}." if at else ""
    if get_origin(kind) is UnionType:
        if not any(name == at or name.startswith(below) for name in tensors):
            return None
        (kind,) = (each for each in get_args(kind) if each is not type(None))
    if is_dataclass(kind):
        types = get_type_hints(kind)
        return kind(  # type: ignore[operator]
            **{item.name: _rebuilt(types[item.name], tensors, below + item.name, device) for item in fields(kind)}
        )
    if get_origin(kind) is dict:
        names = dict.fromkeys(name.removeprefix(below) for name in tensors if name.startswith(below))
        return {name: _rebuilt(get_args(kind)[1], tensors, below + name, device) for name in names}
    if get_origin(kind) is list:
        return [_rebuilt(get_args(kind)[0], tensors, below + str(n), device) for n in range(int(tensors[at]))]
    if kind is Tensor:
        return tensors[at].to(device)
    return tensors[at].item() if kind in (bool, int, float) else tensors[at].numpy()
