# SPDX-License-Identifier: Apache-2.0
"""Write files completely or not at all: to a temporary file in the same folder, which is then renamed."""

from __future__ import annotations

import filecmp
import hashlib
import os
import re
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

from .errors import SsilkError, fail

WRITABLE = "choose an output folder that exists and that you may write to"
UNFINISHED = ".{}.partial-{}-"  # start of temporary names: the stem of the target, and who writes
_WRITER = re.compile(r"\.partial-(?P<host>[0-9a-f]+)\.(?P<process>\d+)\.(?P<began>\d+)-")
USD_NAMES, USD_BEGINNINGS = (".usd", ".usda", ".usdc", ".usdz"), (b"PXR-USDC", b"#usda ")
STEM = 64  # characters of a target's stem in temporary names, which may have 255 in all
ABANDONED = 24 * 3600.0  # seconds without a change after which a temporary file's writer has ended, wherever it ran


@contextmanager
def replacing(target: str | Path, *, keep_same: bool = False) -> Iterator[Path]:
    """Yield a temporary path beside `target`; rename it to `target` on success, remove it on failure.

    With `keep_same`, a target that already has the same bytes keeps its modification time.

    The temporary name keeps the suffix of `target`, because USD chooses the file format by it. Errors that name the
    temporary file are raised again with the name of `target`.

    Raises:
        SsilkError: `target` cannot be written (no such folder, no permission, no space).
    """
    target = Path(target)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        prefix = UNFINISHED.format(target.stem[:STEM], _writer())
        handle, name = tempfile.mkstemp(prefix=prefix, suffix=target.suffix, dir=target.parent)
        os.close(handle)
    except OSError as error:
        raise SsilkError(f"{target}: cannot be written ({error.strerror or error}); {WRITABLE}.") from error
    temporary = Path(name)
    try:
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        with temporary.open("rb+") as stream:
            os.fsync(stream.fileno())  # without it a power failure could leave an empty target
        if not (keep_same and target.is_file() and filecmp.cmp(temporary, target, shallow=False)):
            temporary.replace(target)
    except SsilkError as error:
        raise type(error)(str(error).replace(str(temporary), str(target))) from error
    except OSError as error:
        raise SsilkError(
            f"{target}: writing failed ({error.strerror or error}); free some space or choose another output."
        ) from error
    finally:
        temporary.unlink(missing_ok=True)


def remove_unfinished(target: str | Path) -> None:
    """Remove temporary files beside `target` whose writers have ended; others may write `target` meanwhile."""
    target = Path(target)
    stem = re.escape(UNFINISHED.format(target.stem[:STEM], "").removesuffix("-"))
    _remove(target.parent, re.compile(rf"\.?{stem}.*{re.escape(target.suffix)}", re.DOTALL))


def remove_unfinished_in(folder: str | Path) -> None:
    """Remove the temporary files in a folder whose writers have ended."""
    _remove(Path(folder), re.compile(r"\..*\.partial-.*", re.DOTALL))


def _remove(folder: Path, names: re.Pattern[str]) -> None:
    try:
        found = [path for path in folder.iterdir() if names.match(path.name)]
    except (FileNotFoundError, NotADirectoryError):
        return
    for path in found:
        if _has_ended(path):
            path.unlink(missing_ok=True)


def _has_ended(temporary: Path) -> bool:
    """Return whether the writer of a temporary file has ended: seen here, or because the file stays as it is."""
    writer = _WRITER.search(temporary.name)
    if writer and writer["host"] == _host():
        return not _is_running(int(writer["process"]), int(writer["began"]))
    try:
        return time.time() - temporary.stat().st_mtime > ABANDONED
    except FileNotFoundError:
        return True


def _writer() -> str:
    """Return this process, as no other is called: a number that is given again comes with another start."""
    return f"{_host() or '0'}.{os.getpid()}.{_began(os.getpid()) or 0}"


@lru_cache(maxsize=1)
def _host() -> str:
    """Return where processes have their numbers from: a start of this machine, and a container; "" if unknown."""
    if not sys.platform.startswith("linux"):
        return ""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text()
        return hashlib.sha256(f"{boot} {os.readlink('/proc/self/ns/pid')}".encode()).hexdigest()[:12]
    except OSError:
        return ""


def _is_running(process: int, began: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # another user's, which /proc may hide
        pass
    return _began(process) in (began, None)


def _began(process: int) -> int | None:
    """Return when a process began, in ticks since the machine did; 0 if it has ended, None if that cannot be seen."""
    try:
        state, *rest = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return 0 if state in "ZX" else int(rest[18])


def is_usd(path: Path) -> bool:
    """Return whether a file is one of USD, by its name or by how it begins."""
    with path.open("rb") as file:
        begins = file.read(len(USD_BEGINNINGS[0]))
    return path.suffix in USD_NAMES or begins.startswith(USD_BEGINNINGS)


def split_location(text: str) -> tuple[str, str | None]:
    """Split "file[:/Prim/Path]" into file and prim path (None without one)."""
    file, colon, prim = text.rpartition(":/")
    # "C:/file.usd" is a file: the part before a prim path must have a suffix.
    return (file, f"/{prim}") if colon and Path(file).suffix else (text, None)


def split_body(text: str) -> tuple[str, str]:
    """Split "file[:SHAPE=WEIGHT,...]", a body of a stage, into the file and its shapes ("" without any).

    Names of shapes may have colons, as namespaces do. A path of a prim after it stays with the file: `split_location`
    goes first.
    """
    found = re.fullmatch(rf"(.*?[^/](?:{'|'.join(map(re.escape, USD_NAMES))})):([^/]*=[^/]*)", text, flags=re.DOTALL)
    return (found[1], found[2]) if found else (text, "")


def need_writable(target: str | Path) -> None:
    """Check before a long task that `target` can be written; leave no file behind.

    Raises:
        SsilkError: `target` is a folder, or its folder cannot be created or written to.
    """
    target = Path(target)
    if target.is_dir():
        fail(str(target), "this is a folder", "the output is a file", "add a file name")
    folder = next(above for above in target.absolute().parents if above.exists())
    need_folder(target.parent)
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        fail(str(target), f"cannot be written ({error.strerror or error})", WRITABLE)


def need_folder(target: str | Path) -> None:
    """Raise `SsilkError` where files are to be written into `target`, which is a file itself, or lies in one."""
    for above in (Path(target), *Path(target).parents):
        if above.exists():
            if not above.is_dir():
                fail(str(above), "this is a file", "the output is a folder, there already or not", "name another one")
            return


def is_same_file(path: str | Path, other: str | Path) -> bool:
    """Return whether two paths lead to one file, however they are written; links are followed."""
    path, other = Path(path), Path(other)
    return path == other or (path.exists() and other.exists() and path.samefile(other))


def need_not_input(target: str | Path, *inputs: Path | str | None) -> None:
    """Raise `SsilkError` if `target` is one of the `inputs`, which are never overwritten."""
    target = Path(target)
    files = [Path(split_body(str(path))[0]) for path in inputs if path]
    same = target.exists() and any(path.exists() and target.samefile(path) for path in files)
    if same:
        fail(str(target), "the output is also an input", "inputs are never overwritten", "name another file")


def sha256(path: str | Path) -> str:
    """Return the SHA-256 of a file's bytes as hexadecimal text."""
    digest = hashlib.sha256()
    with open(path, "rb") as stream:
        while block := stream.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def relative_path(path: str | Path, folder: str | Path) -> str | None:
    """Return a path as seen from a folder, with forward slashes; None where they share nothing but the root."""
    place, home = os.path.abspath(path), os.path.abspath(folder)
    try:
        shared = Path(os.path.commonpath([place, home]))
    except ValueError:  # on another drive
        return None
    return None if shared == Path(shared.anchor) else Path(os.path.relpath(place, home)).as_posix()


class FileHashes:
    """SHA-256 of files, which are read again only where they may have changed.

    A file counts as the same while its device, inode, size, and times of modification and of change are the same.
    Programs cannot set the time of change. What stays unseen is a file that is rewritten in place, with the same
    size, within one tick of its file system's clock (some milliseconds) after it was read.
    """

    def __init__(self) -> None:
        self._known: dict[tuple[int, ...], str] = {}

    def sha256(self, path: str | Path) -> str:
        """Return the SHA-256 of a file's bytes as hexadecimal text; raise `OSError` where it cannot be read."""
        found = os.stat(path)  # before the bytes: where they change meanwhile, they are read again next time
        state = (found.st_dev, found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns)
        if state not in self._known:
            self._known[state] = sha256(path)
        return self._known[state]
