# SPDX-License-Identifier: Apache-2.0
"""Write files completely or not at all: to a temporary file in the same folder, which is then renamed."""

from __future__ import annotations

import filecmp
import glob
import hashlib
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from .errors import SsilkError, fail

WRITABLE = "choose an output folder that exists and that you may write to"
UNFINISHED = ".{}.partial-"  # start of temporary names; the braces stand for the stem of the target


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
        prefix = UNFINISHED.format(target.stem)
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
    """Remove temporary files that killed processes left beside `target`.

    No other process may write `target` at the same time.
    """
    target = Path(target)
    name = glob.escape(UNFINISHED.format(target.stem))
    for prefix in (name, f".{name}"):  # the second: a writer that itself replaces its file
        for path in target.parent.glob(f"{prefix}*{glob.escape(target.suffix)}"):
            path.unlink(missing_ok=True)


def need_writable(target: str | Path) -> None:
    """Check before a long task that `target` can be written; leave no file behind.

    Raises:
        SsilkError: `target` is a folder, or its folder cannot be created or written to.
    """
    target = Path(target)
    if target.is_dir():
        fail(str(target), "this is a folder", "the output is a file", "add a file name")
    folder = next(above for above in target.absolute().parents if above.exists())
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        fail(str(target), f"cannot be written ({error.strerror or error})", WRITABLE)


def need_not_input(target: str | Path, *inputs: Path | str | None) -> None:
    """Raise `SsilkError` if `target` is one of the `inputs`, which are never overwritten."""
    target = Path(target)
    same = target.exists() and any(Path(path).exists() and target.samefile(path) for path in inputs if path)
    if same:
        fail(str(target), "the output is also an input", "inputs are never overwritten", "name another file")


def sha256(path: str | Path) -> str:
    """Return the SHA-256 of a file's bytes as hexadecimal text."""
    digest = hashlib.sha256()
    with open(path, "rb") as stream:
        while block := stream.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()
