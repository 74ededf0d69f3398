# SPDX-License-Identifier: Apache-2.0
"""Read a glTF 2.0 binary [Khronos 2021], whoever wrote it: its document, and its accessors as arrays.

Read are accessors of any component type, normalized or not, interleaved, sparse, in any number of buffer views and of
buffers that the file holds. KHR_mesh_quantization allows integers for vertices, and needs nothing else. Compressed
data is refused by the name of its extension.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import fail
from .container import BINARY, CHUNK, HEADER, JSON, MAGIC, VERSION, WIDTHS, Document, write_chunks

MAX_READ = 1 << 28  # bytes that one accessor may take in memory
QUANTIZED = "KHR_mesh_quantization"
# Extensions that a file may require without a change to its vertices, by how their names begin.
HARMLESS = (QUANTIZED, "KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_")
COMPONENTS: dict[int, np.dtype[Any]] = {
    5120: np.dtype("i1"),
    5121: np.dtype("u1"),
    5122: np.dtype("<i2"),
    5123: np.dtype("<u2"),
    5125: np.dtype("<u4"),
    5126: np.dtype("<f4"),
}


@contextmanager
def understood(name: str, found: str, allowed: str, todo: str) -> Iterator[None]:
    """Raise `SsilkError` with these words where a document is of another shape than its reader takes it for."""
    try:
        yield
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, RecursionError) as error:
        fail(name, f"{found} ({type(error).__name__}: {error})", allowed, todo)


def listed(items: Any, index: Any) -> Any:
    """Return an item of a list of a document.

    Raises:
        IndexError: the index is negative, which Python would count from the end, or behind the last item.
        TypeError: it is no number, or there is no list.
    """
    if isinstance(index, bool) or not isinstance(index, int) or not isinstance(items, list):
        raise TypeError(f"{index!r} is no index")
    if not 0 <= index < len(items):
        raise IndexError(f"item {index} of {len(items)}")
    return items[index]


class GlbFile:
    """A glb that was read.

    Attributes:
        document: its JSON document.
    """

    def __init__(self, path: str | Path) -> None:
        """Read a file.

        Raises:
            SsilkError: it cannot be read, is not a glb of version 2, or requires an extension that is not read.
        """
        self.path = Path(path)
        try:
            data = self.path.read_bytes()
        except OSError as error:
            fail(str(path), f"it cannot be read ({error.strerror or error})", "a .glb file is needed")
        try:
            self.document, self._binary = _parts(data)
        except (struct.error, ValueError, RecursionError) as error:
            fail(str(path), f"not a whole glb ({error})", "a file of glTF 2.0 is needed", "bake it again")
        required = self.document.get("extensionsRequired", [])
        for name in required if isinstance(required, list) else ():
            if not str(name).startswith(HARMLESS):
                fail(
                    str(path),
                    f"its data needs the extension {name}, which is not read",
                    f"plain glTF 2.0 and {QUANTIZED} are",
                    "write it without this extension",
                )
        self._buffers: dict[int, bytes] = {}

    def write(self, path: str | Path) -> None:
        """Write the document as it is now, with the buffer that was read.

        Raises:
            SsilkError: it would be larger than its format allows.
        """
        write_chunks(path, self.document, [self._binary])

    @property
    def is_quantized(self) -> bool:
        """Whether vertices are stored as integers, which rounds them."""
        return QUANTIZED in self.document.get("extensionsUsed", [])

    def array(self, index: int) -> np.ndarray:
        """Return what an accessor holds, shape (N, width), in its own type, or as float32 where it is normalized.

        Raises:
            KeyError, IndexError, TypeError, ValueError: the document is malformed.
        """
        item = listed(self.document["accessors"], index)
        count, width, kind = item["count"], WIDTHS[item["type"]], COMPONENTS[item["componentType"]]
        if not (isinstance(count, int) and 0 <= count * width * max(kind.itemsize, 4) <= MAX_READ):
            raise ValueError(f"an accessor of {count} values")
        if "bufferView" in item:
            values = self._rows(item["bufferView"], item.get("byteOffset", 0), count, width, kind)
        else:
            values = np.zeros((count, width), dtype=kind)
        if sparse := item.get("sparse"):
            few, of, new = sparse["count"], sparse["indices"], sparse["values"]
            numbers = COMPONENTS[of["componentType"]]
            rows = self._rows(of["bufferView"], of.get("byteOffset", 0), few, 1, numbers)[:, 0]
            if not (rows >= 0).all():
                raise IndexError("a sparse value of an element below zero")
            values = values.copy()
            values[rows] = self._rows(new["bufferView"], new.get("byteOffset", 0), few, width, kind)
        return _normalized(values) if item.get("normalized") else values

    def view_bytes(self, index: int) -> bytes:
        """Return the bytes of a buffer view that is not interleaved.

        Raises:
            KeyError, IndexError, TypeError, ValueError: the document is malformed.
        """
        item = listed(self.document["bufferViews"], index)
        begin, length = item.get("byteOffset", 0), item["byteLength"]
        data = self._buffer(item["buffer"])[begin : begin + length]
        if "byteStride" in item or len(data) != length:
            raise ValueError(f"buffer view {index} is interleaved, or ends behind its buffer")
        return data

    def _rows(self, view: int, start: int, count: int, width: int, kind: np.dtype[Any]) -> np.ndarray:
        """Return the elements of a buffer view from a byte on, shape (count, width), interleaved or not."""
        item = listed(self.document["bufferViews"], view)
        size = width * kind.itemsize
        stride, begin = item.get("byteStride", size), item.get("byteOffset", 0)
        if not (stride >= size and count >= 0 and start >= 0 and begin >= 0):
            raise ValueError(f"buffer view {view} has a stride of {stride} bytes")
        if count and start + stride * (count - 1) + size > item["byteLength"]:
            raise ValueError(f"buffer view {view} ends before its values")
        data = self._buffer(item["buffer"])
        return np.ndarray((count, width), kind, data, begin + start, (stride, kind.itemsize))

    def _buffer(self, index: int) -> bytes:
        if index not in self._buffers:
            uri = listed(self.document["buffers"], index).get("uri")
            if uri is None and index == 0:
                self._buffers[index] = self._binary
            elif str(uri).startswith("data:"):
                self._buffers[index] = base64.b64decode(str(uri).partition(",")[2], validate=True)
            else:
                raise ValueError(f"buffer {index} is in another file")
        return self._buffers[index]


def _normalized(values: np.ndarray) -> np.ndarray:
    """Return integers as the numbers from 0 or -1 to 1 that they stand for."""
    if values.dtype.kind == "f":
        return values
    return np.maximum(values.astype(np.float32) / np.iinfo(values.dtype).max, -1.0)


def _parts(data: bytes) -> tuple[Document, bytes]:
    """Return the document and the binary chunk, empty where there is none; chunks of other kinds are skipped."""
    magic, version, total = HEADER.unpack_from(data)
    if magic != MAGIC or version != VERSION or total != len(data):
        raise ValueError("another header or length")
    chunks: list[tuple[bytes, bytes]] = []
    start = HEADER.size
    while start < len(data):
        length, kind = CHUNK.unpack_from(data, start)
        start += CHUNK.size
        if start + length > len(data):
            raise ValueError("a chunk that ends behind the file")
        chunks.append((kind, data[start : start + length]))
        start += length
    if not chunks or chunks[0][0] != JSON:
        raise ValueError("other chunks")
    document = json.loads(chunks[0][1])
    if not isinstance(document, dict):
        raise ValueError("another document")
    return document, next((part for kind, part in chunks[1:] if kind == BINARY), b"")
