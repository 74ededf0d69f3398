# SPDX-License-Identifier: Apache-2.0
"""Reading safetensors files without the library: what the library wrote, and nothing that it would refuse."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from ssilk_core.network.tensors import TYPES, read_tensors

RANDOM = np.random.default_rng(0)
TENSORS = {
    **{name: (100 * RANDOM.standard_normal((3, 4))).astype(kind) for name, kind in TYPES.items()},
    "scalar": np.array(2.5),
    "empty": np.zeros((0, 3), np.float32),
}


def written(path: Path, header: object, data: bytes = b"", *, length: int | None = None) -> Path:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    path.write_bytes((len(text) if length is None else length).to_bytes(8, "little") + text + data)
    return path


def test_every_type_is_read_as_the_library_reads_it(tmp_path):
    save_file(TENSORS, tmp_path / "all.safetensors", {"ssilk": "words"})
    found, words = read_tensors(tmp_path / "all.safetensors")
    assert words == {"ssilk": "words"} and found.keys() == TENSORS.keys()
    for name, expected in TENSORS.items():
        assert found[name].dtype == expected.dtype
        np.testing.assert_array_equal(found[name], expected)


def entry(**changes: object) -> dict[str, object]:
    return {"a": {"dtype": "F32", "shape": [2], "data_offsets": [0, 8]} | changes}


@pytest.mark.parametrize(
    ("header", "words"),
    [
        (b"no JSON", "Expecting value"),
        (b"[" * 100_000, "nested too deeply"),
        ([1], "not a table"),
        ({"__metadata__": 3}, "not a table of text"),
        ({"a": 3}, "incomplete description"),
        ({"a": {"dtype": "F32"}}, "incomplete description"),
        (entry(dtype="BF16"), "unsupported type BF16"),
        (entry(dtype=["F32"]), "unsupported type"),
        (entry(shape=[True]), "invalid shape or byte range"),
        (entry(shape=[-2]), "invalid shape or byte range"),
        (entry(shape="2"), "invalid shape or byte range"),
        (entry(shape=[10**30]), "does not match"),
        (entry(shape=[3]), "does not match"),
        (entry(data_offsets=[0, 8, 9]), "incomplete description"),
        (entry(data_offsets=[8, 16]), "does not match"),
        (entry(data_offsets=[0, 16], shape=[4]), "take 16 bytes, but it has 8"),
        ({}, "take 0 bytes, but it has 8"),
        ({**entry(), "b": entry()["a"]}, "'b' does not match"),
    ],
)
def test_what_is_damaged_is_refused_in_words(tmp_path, header, words):
    path = written(tmp_path / "bad.safetensors", header, bytes(8))
    with pytest.raises(ValueError, match=words):
        read_tensors(path)


@pytest.mark.parametrize("length", [0, 10**18, (64 << 20) + 1])
def test_headers_that_cannot_be_are_refused_unread(tmp_path, length):
    path = written(tmp_path / "bad.safetensors", entry(), bytes(8), length=length)
    with pytest.raises(ValueError, match="header has an invalid length"):
        read_tensors(path)


def test_no_byte_that_is_changed_gets_past(tmp_path):
    """Either both readers refuse a file or both read the same, up to the library's stricter reading of JSON."""
    path, bad = tmp_path / "good.safetensors", tmp_path / "bad.safetensors"
    save_file({"a": np.arange(6.0).reshape(2, 3), "b": np.arange(3, dtype=np.int16)}, path)
    good = path.read_bytes()
    for place in range(len(good)):
        for value in (good[place] ^ 1, good[place] ^ 0x10, 0x30):
            bad.write_bytes(good[:place] + bytes([value]) + good[place + 1 :])
            _need_as_the_library(bad)
    for stop in range(len(good)):
        bad.write_bytes(good[:stop])
        with pytest.raises(ValueError):
            read_tensors(bad)


def _need_as_the_library(path: Path) -> None:
    try:
        expected = load_file(path)
    except (SafetensorError, KeyError, TypeError):
        expected = None
    try:
        found, _ = read_tensors(path)
    except ValueError:
        assert expected is None
        return
    for name, values in (expected or {}).items():
        np.testing.assert_array_equal(found[name], values)
