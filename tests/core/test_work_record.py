# SPDX-License-Identifier: Apache-2.0
"""Records: work is done while its request and its files are the same."""

from __future__ import annotations

import pytest

from ssilk_core.errors import SsilkError
from ssilk_core.files import sha256
from ssilk_core.work_record import WorkRecord, read_record, request_key, write_record


def test_a_key_is_of_the_request_and_of_the_contents_of_its_inputs():
    keys = {
        request_key(["a"], [("x", "1")]), request_key(["b"], [("x", "1")]), request_key(["a"], [("x", "2")]),
        request_key(["a"], [("y", "1")]), request_key(["a"], []), request_key(["a"], [("x", "1"), ("x", "1")]),
    }  # fmt: skip
    assert len(keys) == 6
    assert request_key({"a": 1, "b": 2}, []) == request_key({"b": 2, "a": 1}, [])


def test_work_is_done_while_its_files_are_as_they_were_written(tmp_path):
    path, file = tmp_path / "cape.json", tmp_path / "cape.usdc"
    file.write_bytes(b"shot")
    record = WorkRecord(key="k", files={"cape.usdc": sha256(file)}, detail={"frames": 3})
    write_record(path, record)
    assert read_record(path) == record and record.is_done(tmp_path)
    file.write_bytes(b"shut")
    assert not record.is_done(tmp_path)
    file.unlink()
    assert not record.is_done(tmp_path)
    assert not WorkRecord(key="k").is_done(tmp_path)
    assert read_record(tmp_path / "none.json") is None


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"key": 1}', '{"key": "k", "files": 3}', "[" * 100_000])
def test_a_damaged_record_is_told_in_one_sentence(tmp_path, text):
    (tmp_path / "cape.json").write_text(text)
    with pytest.raises(SsilkError, match=r"cape.json: this record of finished work is damaged .*delete it"):
        read_record(tmp_path / "cape.json")
