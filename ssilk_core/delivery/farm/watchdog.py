# SPDX-License-Identifier: Apache-2.0
"""End the processes of a cluster when the process that started it ends, even if that is killed.

Ray ends its own processes then, but not those that were just starting. A process of its own waits for the end of this
one, and kills what it saw with its mark in the environment: Ray's processes overwrite their environment with their
title, some time after they start. It runs this file alone.
"""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

VARIABLE = "SSILK_CLUSTER"
PERIOD, QUIET = 0.3, 4  # [s] between two looks at all processes, and looks that find none before it ends


@contextmanager
def ended_together() -> Iterator[None]:
    """Mark the processes that are started within; end them afterwards, or when this process ends (Linux)."""
    if not sys.platform.startswith("linux"):
        yield
        return
    mark = uuid.uuid4().hex
    watcher = subprocess.Popen([sys.executable, __file__, mark], stdin=subprocess.PIPE, start_new_session=True)
    os.environ[VARIABLE] = mark
    try:
        yield
    finally:
        del os.environ[VARIABLE]
        watcher.communicate()


def marked(mark: str, seen: set[tuple[int, str]]) -> set[tuple[int, str]]:
    """Return number and start of the processes that carry a mark, or were `seen` with it, and have not ended."""
    found = set()
    for path in Path("/proc").glob("[0-9]*"):
        try:
            state, *rest = (path / "stat").read_text().rpartition(")")[2].split()
            process = int(path.name), rest[18]
            carries = process in seen or f"{VARIABLE}={mark}".encode() in (path / "environ").read_bytes().split(b"\0")
        except OSError:  # it has ended, or is another user's
            continue
        if carries and state not in "ZX":
            found.add(process)
    return found


def _watch(mark: str) -> None:
    seen: set[tuple[int, str]] = set()
    while not select.select([sys.stdin], [], [], PERIOD)[0]:  # until the other process closes it, or ends
        seen = marked(mark, seen)
    quiet = 0
    while quiet < QUIET:
        seen = marked(mark, seen)
        quiet = 0 if seen else quiet + 1
        for process, _ in seen:
            with suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
        time.sleep(PERIOD)


if __name__ == "__main__":
    _watch(sys.argv[1])
