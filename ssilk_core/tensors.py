# SPDX-License-Identifier: Apache-2.0
"""Read safetensors files with only numpy, for environments without the library; the content is not trusted.

A file has the length of the header (8 bytes, little endian), the header (JSON with the type, shape and byte range of
each tensor), and the tensors without gaps [huggingface.co/docs/safetensors].
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

HEADER_LIMIT = 64 << 20  # [bytes]; a larger header is damaged or malicious
TYPES = {
    "BOOL": "?", "U8": "u1", "I8": "i1", "U16": "<u2", "I16": "<i2", "U32": "<u4", "I32": "<i4", "U64": "<u8",
    "I64": "<i8", "F16": "<f2", "F32": "<f4", "F64": "<f8",
}  # fmt: skip
Tensors = dict[str, NDArray]


@dataclass(frozen=True)
class Place:
    """Name, type, shape and byte range of a tensor, counted from the end of the header."""

    name: str
    kind: np.dtype
    shape: list[int]
    start: int
    stop: int

    def read(self, data: bytes) -> NDArray:
        """Return the tensor with this content."""
        return np.frombuffer(bytearray(data), self.kind).reshape(self.shape)


def read_tensors(path: Path) -> tuple[Tensors, dict[str, str]]:
    """Return the tensors of a file by name, and the text metadata in its header.

    Raises:
        ValueError: the file is not a safetensors file, is damaged, or has a type that numpy lacks.
    """
    with path.open("rb") as stream:
        size = int.from_bytes(stream.read(8).ljust(8, b"\0"), "little")
        if not 0 < size <= HEADER_LIMIT:
            raise ValueError("its header has an invalid length")
        header = _header(stream.read(size))
        words, left = header.pop("__metadata__", {}), path.stat().st_size - 8 - size
        if not isinstance(words, dict):
            raise ValueError("its metadata is not a table of text")
        places = sorted(_entries(header), key=lambda place: (place.start, place.stop))
        _need_filled(places, left)
        return {place.name: place.read(stream.read(place.stop - place.start)) for place in places}, words


def _need_filled(places: list[Place], size: int) -> None:
    """Raise `ValueError` unless tensors match their byte ranges, and these fill `size` bytes without gaps."""
    end = 0
    for place in places:
        needed = math.prod(place.shape) * place.kind.itemsize
        if place.start != end or place.stop - place.start != needed:
            raise ValueError(f"tensor '{place.name}' does not match its byte range")
        end = place.stop
    if end != size:
        raise ValueError(f"its tensors take {end} bytes, but it has {size}")


def _header(text: bytes) -> dict[str, Any]:
    try:
        header = json.loads(text)
    except RecursionError as error:
        raise ValueError("its header is nested too deeply") from error
    if not isinstance(header, dict):
        raise ValueError("its header is not a table")
    return header


def _entries(header: dict[str, Any]) -> Iterator[Place]:
    """Yield the entries of all tensors; only the types of their fields are checked."""
    for name, entry in header.items():
        try:
            kind, shape, (start, stop) = entry["dtype"], entry["shape"], entry["data_offsets"]
        except (TypeError, KeyError, ValueError) as error:
            raise ValueError(f"tensor '{name}' has an incomplete description") from error
        if not isinstance(kind, str) or kind not in TYPES:
            raise ValueError(f"tensor '{name}' has the unsupported type {str(kind)[:40]}")
        if not isinstance(shape, list) or any(type(each) is not int or each < 0 for each in (*shape, start, stop)):
            raise ValueError(f"tensor '{name}' has an invalid shape or byte range")
        yield Place(name, np.dtype(TYPES[kind]), shape, start, stop)
