# SPDX-License-Identifier: Apache-2.0
"""Files appear whole or not at all."""

import errno
import hashlib
import os
import re
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from ssilk_core import files
from ssilk_core.delivery.bake import naming, origin
from ssilk_core.errors import SsilkError, VerificationError
from ssilk_core.files import need_writable, remove_unfinished, remove_unfinished_in, replacing, sha256


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


def killed_while_writing(*targets: Path) -> None:
    """Leave half of each target under its temporary name, as a process does that is killed."""
    words = (
        "import os, sys; from ssilk_core.files import replacing; held = [replacing(path) for path in sys.argv[1:]]; "
        "[each.__enter__().write_text('half') for each in held]; os.kill(os.getpid(), 9)"
    )
    subprocess.run([sys.executable, "-c", words, *map(str, targets)])


def hidden(folder: Path) -> set[str]:
    return {path.name.split(".partial-")[0] for path in folder.iterdir() if path.name.startswith(".")}


def test_what_killed_processes_left_of_a_file_is_removed_and_nothing_else(tmp_path):
    targets = [tmp_path / name for name in ("mo[d]el.safetensors", "mo[d]el.resume.safetensors", "d.safetensors")]
    killed_while_writing(*targets)
    for target in targets:
        target.write_text("older")
    remove_unfinished(targets[0])
    assert hidden(tmp_path) == {".mo[d]el.resume", ".d"}
    remove_unfinished_in(tmp_path)
    assert not hidden(tmp_path)
    assert all(target.read_text() == "older" for target in targets)
    remove_unfinished(tmp_path / "none" / "model.safetensors")


def test_what_others_are_writing_stays_until_it_is_a_day_old(tmp_path):
    with replacing(tmp_path / "ours.bin") as ours:
        elsewhere = ours.with_name(re.sub("partial-[^.]*", "partial-abc", ours.name))  # on another machine
        elsewhere.touch()
        for remove in (lambda: remove_unfinished(tmp_path / "ours.bin"), lambda: remove_unfinished_in(tmp_path)):
            remove()
            assert ours.exists() and elsewhere.exists()
        for path in (ours, elsewhere):
            os.utime(path, (0, 0))
        remove_unfinished_in(tmp_path)
        assert ours.exists() and not elsewhere.exists()


def test_files_are_hashed_again_only_where_they_may_have_changed(tmp_path, monkeypatch):
    read, path, hashes = [], tmp_path / "a", files.FileHashes()
    monkeypatch.setattr(files, "sha256", lambda path: (read.append(path), sha256(path))[1])
    path.write_text("one")
    first = [hashes.sha256(path), hashes.sha256(tmp_path / "." / ".." / tmp_path.name / "a")]
    assert first == [sha256(path)] * 2 and len(read) == 1
    stamp = path.stat().st_mtime_ns
    (tmp_path / "b").write_text("two")
    os.utime(tmp_path / "b", ns=(stamp, stamp))
    (tmp_path / "b").replace(path)  # published with the same name, size and time of modification
    assert hashes.sha256(path) == sha256(path) != first[0]


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
    with pytest.raises(SsilkError, match="file: this is a file; the output is a folder"):
        need_writable(tmp_path / "file" / "below" / "shot.usdc")
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


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("walk.usdc", ("walk.usdc", None)),
        ("walk.usdc:/Clip", ("walk.usdc", "/Clip")),
        ("C:/clips/walk.usdc", ("C:/clips/walk.usdc", None)),
        ("C:/clips/walk.usdc:/World/Clip", ("C:/clips/walk.usdc", "/World/Clip")),
    ],
)
def test_a_location_is_split_alike_by_all_who_read_one(text, parts):
    """Drives are no files with a prim, in names of shots and bundles of farms too."""
    assert files.split_location(text) == parts
    assert naming.location_stem(text) == "walk" + ("_Clip" if parts[1] else "")
    assert naming.pattern_name("{stem}", text, "--shot-name") == "walk"
    assert origin._name(text) == "walk.usdc" + (f":{parts[1]}" if parts[1] else "")
