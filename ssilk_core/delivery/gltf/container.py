# SPDX-License-Identifier: Apache-2.0
"""The container of glTF 2.0 [Khronos 2021]: one JSON document, and one buffer that its accessors view."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ... import __version__
from ...errors import fail

Document = dict[str, Any]

MAGIC, VERSION, JSON, BINARY = b"glTF", 2, b"JSON", b"BIN\0"
HEADER, CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
MAX_BYTES = 2**32 - 1  # a length is stored in four bytes
MAX_READ = 1 << 28  # bytes that one accessor may take in memory
VERTICES, INDICES = 34962, 34963  # what a buffer view is bound as
COMPONENTS: dict[int, np.dtype[Any]] = {
    5121: np.dtype("u1"),
    5123: np.dtype("<u2"),
    5125: np.dtype("<u4"),
    5126: np.dtype("<f4"),
}
_CODES = {kind: code for code, kind in COMPONENTS.items()}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class GlbBuilder:
    """Collects the parts of a document and the arrays of its buffer; `write` writes both.

    Attributes:
        document: the JSON document so far.
    """

    def __init__(self) -> None:
        self.document: Document = {"asset": {"version": "2.0", "generator": f"ssilk {__version__}"}}
        self._parts: list[bytes] = []
        self._size = 0

    def add(self, kind: str, item: Mapping[str, object]) -> int:
        """Append an item to a list of the document, such as "nodes"; return its index."""
        items = self.document.setdefault(kind, [])
        items.append(dict(item))
        return len(items) - 1

    def array(self, values: np.ndarray, kind: str, *, use: int | None = None, bounds: bool = False) -> int:
        """Add an accessor of an array (N, width), or (N,) for scalars; return its index.

        Args:
            kind: "SCALAR", "VEC3" and so on.
            use: `VERTICES` or `INDICES` where it is bound as such.
            bounds: store the least and the greatest value of each column.
        """
        item = {"bufferView": self._view(values, use), **_described(values, kind)}
        return self.add("accessors", {**item, **(_bounds(values) if bounds else {})})

    def offsets(self, values: np.ndarray) -> int:
        """Add an accessor of float32 vectors (N, 3) with bounds, its zero rows left out where that is smaller."""
        rows = np.flatnonzero(values.any(axis=1))
        numbers = rows.astype("<u2" if len(values) <= 2**16 else "<u4")
        if numbers.nbytes + 12 * len(rows) >= values.nbytes:
            return self.array(values, "VEC3", use=VERTICES, bounds=True)
        item = {**_described(values, "VEC3"), **_bounds(values)}
        if len(rows):  # an accessor without a view is all zeros
            item["sparse"] = {
                "count": len(rows),
                "indices": {"bufferView": self._view(numbers, None), "componentType": _CODES[numbers.dtype]},
                "values": {"bufferView": self._view(values[rows], None)},
            }
        return self.add("accessors", item)

    def _view(self, values: np.ndarray, use: int | None) -> int:
        data = np.ascontiguousarray(values).tobytes()
        place = {"buffer": 0, "byteOffset": self._size, "byteLength": len(data)}
        padded = data + bytes(-len(data) % 4)
        self._parts.append(padded)
        self._size += len(padded)
        return self.add("bufferViews", place if use is None else {**place, "target": use})

    def write(self, path: str | Path) -> None:
        """Write the file.

        Raises:
            SsilkError: it would be larger than its format allows.
        """
        _write(path, {**self.document, "buffers": [{"byteLength": self._size}]}, self._parts)


def _write(path: str | Path, document: Document, parts: Sequence[bytes]) -> None:
    """Write a document and the parts of its buffer."""
    text = json.dumps(document, separators=(",", ":"), allow_nan=False, ensure_ascii=False).encode()
    text += b" " * (-len(text) % 4)
    size = sum(map(len, parts))
    total = HEADER.size + 2 * CHUNK.size + len(text) + size
    if total > MAX_BYTES:
        fail(str(path), f"{total:,} bytes", f"a glb has at most {MAX_BYTES:,}", "bake a shorter range")
    with open(path, "wb") as stream:
        stream.write(HEADER.pack(MAGIC, VERSION, total))
        stream.write(CHUNK.pack(len(text), JSON) + text)
        stream.write(CHUNK.pack(size, BINARY))
        stream.writelines(parts)


def _described(values: np.ndarray, kind: str) -> Document:
    return {"componentType": _CODES[values.dtype], "count": len(values), "type": kind}


def _bounds(values: np.ndarray) -> Document:
    columns = values.reshape(len(values), -1)
    return {"min": columns.min(axis=0).tolist(), "max": columns.max(axis=0).tolist()}


@contextmanager
def understood(name: str, found: str, allowed: str, todo: str) -> Iterator[None]:
    """Raise `SsilkError` with these words where a document is of another shape than its reader takes it for."""
    try:
        yield
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, RecursionError) as error:
        fail(name, f"{found} ({type(error).__name__}: {error})", allowed, todo)


class GlbFile:
    """A glb that was read.

    Attributes:
        document: its JSON document.
    """

    def __init__(self, path: str | Path) -> None:
        """Read a file.

        Raises:
            SsilkError: it cannot be read, or is not a glb of version 2 with one buffer.
        """
        self.path = Path(path)
        try:
            data = self.path.read_bytes()
        except OSError as error:
            fail(str(path), f"it cannot be read ({error.strerror or error})", "a .glb file is needed")
        try:
            self.document, self._buffer = _parts(data)
        except (struct.error, ValueError, RecursionError) as error:
            fail(str(path), f"not a whole glb ({error})", "a file of glTF 2.0 is needed", "bake it again")

    def write(self, path: str | Path) -> None:
        """Write the document as it is now, with the buffer that was read.

        Raises:
            SsilkError: it would be larger than its format allows.
        """
        _write(path, self.document, [self._buffer])

    def array(self, index: int) -> np.ndarray:
        """Return what an accessor holds, shape (N, width), in its own type.

        Raises:
            KeyError, IndexError, TypeError, ValueError: the document is malformed.
        """
        item = self.document["accessors"][index]
        count, width, kind = item["count"], WIDTHS[item["type"]], COMPONENTS[item["componentType"]]
        if not (isinstance(count, int) and 0 <= count * width * kind.itemsize <= MAX_READ):
            raise ValueError(f"an accessor of {count} values")
        if "bufferView" in item:
            start = item.get("byteOffset", 0)
            values = self._viewed(item["bufferView"], start, count * width, kind).reshape(count, width)
        else:
            values = np.zeros((count, width), dtype=kind)
        if sparse := item.get("sparse"):
            few, of = sparse["count"], sparse["indices"]
            rows = self._viewed(of["bufferView"], of.get("byteOffset", 0), few, COMPONENTS[of["componentType"]])
            new = self._viewed(
                sparse["values"]["bufferView"], sparse["values"].get("byteOffset", 0), few * width, kind
            )
            values = values.copy()
            values[rows] = new.reshape(few, width)
        return values

    def _viewed(self, view: int, start: int, count: int, kind: np.dtype) -> np.ndarray:
        item = self.document["bufferViews"][view]
        if item.get("byteStride") not in (None, kind.itemsize) or start + count * kind.itemsize > item["byteLength"]:
            raise ValueError(f"buffer view {view}")
        return np.frombuffer(self._buffer, kind, count, item.get("byteOffset", 0) + start)


def _parts(data: bytes) -> tuple[Document, bytes]:
    magic, version, total = HEADER.unpack_from(data)
    if magic != MAGIC or version != VERSION or total != len(data):
        raise ValueError("another header or length")
    length, kind = CHUNK.unpack_from(data, HEADER.size)
    start = HEADER.size + CHUNK.size
    document = json.loads(data[start : start + length])
    second, of = CHUNK.unpack_from(data, start + length)
    if not (kind == JSON and of == BINARY and isinstance(document, dict)):
        raise ValueError("other chunks")
    begin = start + length + CHUNK.size
    return document, data[begin : begin + second]
