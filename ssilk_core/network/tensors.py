# SPDX-License-Identifier: Apache-2.0
"""Safetensors files with a checksum, read with only numpy and not trusted; writing needs the library.

A file has the length of the header (8 bytes, little endian), the header (JSON with the type, shape and byte range of
each tensor), and the tensors without gaps [huggingface.co/docs/safetensors]. Its metadata holds the SHA-256 of header
and tensors, with zeros in place of this checksum. Files that another program rewrote may lack it, and are read.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator, Mapping
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
CHECKSUM, NO_CHECKSUM = "sha256", "0" * 64  # its name in the metadata, and what stands there while it is computed
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


def pack_tensors(tensors: Mapping[str, NDArray], words: Mapping[str, str]) -> bytes:
    """Return the content of a file with these tensors, this metadata and their checksum."""
    from safetensors.numpy import save

    written = save(dict(tensors), dict(words))
    size = int.from_bytes(written[:8], "little")
    header, data = json.loads(written[8 : 8 + size]), memoryview(written)[8 + size :]
    header["__metadata__"] = {**words, CHECKSUM: NO_CHECKSUM}
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)  # tensors begin at a multiple of eight bytes
    digest = hashlib.sha256(text)
    digest.update(data)
    text = text.replace(NO_CHECKSUM.encode(), digest.hexdigest().encode())
    return b"".join((len(text).to_bytes(8, "little"), text, data))


def read_tensors(path: Path, word: str = "") -> tuple[Tensors, dict[str, str]]:
    """Return the tensors of a file by name, and the text metadata in its header.

    Args:
        word: the only name that the metadata may have, besides the checksum: a damaged name of the checksum would
            otherwise hide it. Any by default.

    Raises:
        ValueError: the file is not a safetensors file, is damaged, or has a type that numpy lacks.
    """
    with path.open("rb") as stream:
        size = int.from_bytes(stream.read(8).ljust(8, b"\0"), "little")
        if not 0 < size <= HEADER_LIMIT:
            raise ValueError("its header has an invalid length")
        text = stream.read(size)
        header = _header(text)
        words, left = header.pop("__metadata__", {}), path.stat().st_size - 8 - size
        if not isinstance(words, dict):
            raise ValueError("its metadata is not a table of text")
        stated = str(words.pop(CHECKSUM, ""))
        if word and words.keys() - {word}:
            raise ValueError(f"its metadata has the unknown name {min(words.keys() - {word})[:40]!r}")
        digest = hashlib.sha256(text.replace(stated.encode(), NO_CHECKSUM.encode(), 1) if stated else text)
        places = sorted(_entries(header), key=lambda place: (place.start, place.stop))
        _need_filled(places, left)
        tensors = {}
        for place in places:
            data = stream.read(place.stop - place.start)
            digest.update(data)
            tensors[place.name] = place.read(data)
    if stated and stated != digest.hexdigest():
        raise ValueError("its content does not match its checksum")
    return tensors, words


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
