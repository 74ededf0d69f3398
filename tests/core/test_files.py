# SPDX-License-Identifier: Apache-2.0
"""Files appear whole or not at all."""

import errno
import hashlib
import os
import stat
from pathlib import Path

import pytest

from ssilk_core.errors import SsilkError, VerificationError
from ssilk_core.files import need_writable, remove_unfinished, replacing, sha256


def test_a_file_appears_when_it_is_whole(tmp_path):
    target = tmp_path / "new" / "shot.usdc"
    with replacing(target) as temporary:
        temporary.write_text("whole")
        assert temporary.parent == target.parent and temporary.suffix == ".usdc" and temporary.name.startswith(".")
        assert not target.exists()
    assert target.read_text() == "whole" and list(target.parent.iterdir()) == [target]


def test_permissions_are_those_of_any_new_file(tmp_path):
    with replacing(tmp_path / "a") as temporary:
        temporary.touch()
    (tmp_path / "b").touch()
    modes = [stat.S_IMODE((tmp_path / name).stat().st_mode) for name in "ab"]
    assert modes[0] == modes[1]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_whatever_fails_leaves_the_old_file_and_nothing_else(tmp_path, error):
    target = tmp_path / "model.safetensors"
    target.write_text("old")
    with pytest.raises(error), replacing(target) as temporary:
        temporary.write_text("half")
        raise error
    assert target.read_text() == "old" and list(tmp_path.iterdir()) == [target]


def test_bytes_reach_the_disk_before_the_name_does(tmp_path, monkeypatch):
    target, seen = tmp_path / "model.safetensors", []
    sync, rename = os.fsync, Path.replace
    monkeypatch.setattr(os, "fsync", lambda number: (seen.append(os.fstat(number).st_size), sync(number)))
    monkeypatch.setattr(Path, "replace", lambda self, other: (seen.append(other), rename(self, other)))
    with replacing(target) as temporary:
        temporary.write_bytes(b"whole")
    assert seen == [5, target]


def test_what_killed_processes_left_of_a_file_is_removed_and_nothing_else(tmp_path):
    targets = [tmp_path / name for name in ("mo[d]el.safetensors", "mo[d]el.resume.safetensors", "d.safetensors")]
    unfinished = [replacing(target) for target in targets]  # held until the test ends: no writer comes to its own
    for target, writing in zip(targets, unfinished):
        writing.__enter__().write_text("half")
        target.write_text("older")
    remove_unfinished(targets[0])
    left = [path.name for path in tmp_path.iterdir() if path.name.startswith(".")]
    assert len(left) == 2 and not any(name.startswith(".mo[d]el.partial-") for name in left)
    assert all(target.read_text() == "older" for target in targets)
    remove_unfinished(tmp_path / "none" / "model.safetensors")


def test_a_full_disk_is_one_sentence(tmp_path):
    words = r"out.bin: writing failed \(No space left on device\); free some space"
    with pytest.raises(SsilkError, match=words), replacing(tmp_path / "out.bin"):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert not list(tmp_path.iterdir())


def test_a_target_that_is_a_folder_or_lies_in_a_file_is_refused(tmp_path):
    (tmp_path / "folder").mkdir()
    with pytest.raises(SsilkError, match="writing failed"), replacing(tmp_path / "folder") as temporary:
        temporary.touch()
    (tmp_path / "file").touch()
    with pytest.raises(SsilkError, match="cannot be written"), replacing(tmp_path / "file" / "below"):
        pytest.fail("nothing can be written there")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "folder"]


def test_need_writable_makes_nothing_and_refuses_what_cannot_be(tmp_path):
    need_writable(tmp_path / "deep" / "er" / "shot.usdc")
    assert not list(tmp_path.iterdir())
    with pytest.raises(SsilkError, match=r"this is a folder.*add a file name"):
        need_writable(tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(SsilkError, match="cannot be written"):
        need_writable(tmp_path / "file" / "below")
    with pytest.raises(SsilkError, match="cannot be written"):
        need_writable(Path("/proc/none/shot.usdc"))


def test_sha256_is_that_of_the_bytes(tmp_path):
    content = os.urandom((1 << 20) + 17)
    (tmp_path / "a").write_bytes(content)
    assert sha256(tmp_path / "a") == hashlib.sha256(content).hexdigest()


def test_errors_name_the_target_however_deep_they_come_from(tmp_path):
    target = tmp_path / "shot.usda"
    with pytest.raises(VerificationError) as caught, replacing(target) as outer, replacing(outer) as inner:
        raise VerificationError(f"{inner}: vertex 3 is off, and {inner}:/Hero too.")
    assert str(caught.value) == f"{target}: vertex 3 is off, and {target}:/Hero too."
    assert not list(tmp_path.iterdir())
