# SPDX-License-Identifier: Apache-2.0
"""Write the container of glTF 2.0 [Khronos 2021]: one JSON document, and one buffer that its accessors view."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ... import __version__
from ...errors import fail

Document = dict[str, Any]

GENERATOR = "ssilk"  # begins what the file says of who wrote it
MAGIC, VERSION, JSON, BINARY = b"glTF", 2, b"JSON", b"BIN\0"
HEADER, CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
MAX_BYTES = 2**32 - 1  # a length is stored in four bytes
VERTICES, INDICES = 34962, 34963  # what a buffer view is bound as
_CODES: dict[np.dtype[Any], int] = {
    np.dtype("u1"): 5121,
    np.dtype("<u2"): 5123,
    np.dtype("<u4"): 5125,
    np.dtype("<f4"): 5126,
}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class GlbBuilder:
    """Collects the parts of a document and the arrays of its buffer; `write` writes both.

    Attributes:
        document: the JSON document so far.
    """

    def __init__(self) -> None:
        self.document: Document = {"asset": {"version": "2.0", "generator": f"{GENERATOR} {__version__}"}}
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
        return self.bytes_of(np.ascontiguousarray(values).tobytes(), use)

    def bytes_of(self, data: bytes, use: int | None) -> int:
        """Add a view of bytes; return its index.

        Args:
            use: `VERTICES` or `INDICES` where it is bound as such.
        """
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
        write_chunks(path, {**self.document, "buffers": [{"byteLength": self._size}]}, self._parts)


def write_chunks(path: str | Path, document: Document, parts: Sequence[bytes]) -> None:
    """Write a document and the parts of its buffer; raise `SsilkError` where it would be larger than glb allows."""
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
