# SPDX-License-Identifier: GPL-3.0-or-later
"""One command that runs beside Blender and is read without waiting."""

from __future__ import annotations

import os
import queue
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

# Blender's own modules must not reach another Python, nor those of a folder that it happens to stand in.
FOREIGN = ("PYTHONHOME", "PYTHONPATH", "PYTHONSTARTUP", "__PYVENV_LAUNCHER__")
LAST_WORDS = 20  # lines of standard error that are kept
PATIENCE = 5.0  # seconds from a polite stop to a hard one

# How one process is interrupted and not its group: Windows needs a group of its own for that.
if sys.platform == "win32":
    NEW_GROUP, INTERRUPT = subprocess.CREATE_NEW_PROCESS_GROUP, signal.CTRL_BREAK_EVENT
else:
    NEW_GROUP, INTERRUPT = 0, signal.SIGINT


def environment() -> dict[str, str]:
    """Return the environment for another Python: Blender's, without what steers Blender's Python."""
    kept = {name: text for name, text in os.environ.items() if name not in FOREIGN}
    return {**kept, "PYTHONSAFEPATH": "1", "PYTHONUNBUFFERED": "1", "PYTHONIOENCODING": "utf-8"}


@contextmanager
def _heeding_interrupts() -> Iterator[None]:
    """Let what is started here heed interrupts, also where Blender is a shell's background job and ignores them.

    A program inherits which signals are ignored, but not which are handled: those it meets with their defaults.
    """
    in_main = threading.current_thread() is threading.main_thread()  # no other thread may say how signals are met
    if not in_main or signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
        yield
        return
    signal.signal(signal.SIGINT, lambda *_: None)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def started(command: Sequence[str], folder: Path, **pipes: Any) -> subprocess.Popen:
    """Start a command in a folder, in the environment for another Python.

    Args:
        pipes: what `subprocess.Popen` takes for its input and its output.

    Raises:
        OSError: it cannot be started.
    """
    with _heeding_interrupts():
        return subprocess.Popen(command, cwd=folder, env=environment(), creationflags=NEW_GROUP, **pipes)


class Process:
    """A running command; its output is collected by threads, so that `lines` never waits."""

    def __init__(self, command: Sequence[str], folder: Path) -> None:
        """Start `command` in `folder`.

        Raises:
            OSError: it cannot be started.
        """
        self._popen = started(
            command, folder, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            encoding="utf-8", errors="replace",
        )  # fmt: skip
        self._said: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._complaints: deque[str] = deque(maxlen=LAST_WORDS)
        readers = ((self._popen.stdout, self._said.put), (self._popen.stderr, self._complaints.append))
        self._threads = [threading.Thread(target=_read, args=reader, daemon=True) for reader in readers]
        for thread in self._threads:
            thread.start()

    @property
    def running(self) -> bool:
        """Whether it runs, or has output that is still being read."""
        return self._popen.poll() is None or any(thread.is_alive() for thread in self._threads)

    @property
    def exit_code(self) -> int | None:
        """Its exit code; None while it runs."""
        return self._popen.poll()

    @property
    def complaint(self) -> str:
        """The last line that it wrote to standard error, empty if none."""
        return next((line for line in reversed(self._complaints) if line), "")

    def lines(self) -> list[str]:
        """Return what it has printed since the last call."""
        found = []
        while not self._said.empty():
            found.append(self._said.get())
        return found

    def cancel(self) -> None:
        """Ask it to stop; it may still write what it has reached."""
        if self._popen.poll() is None:
            self._popen.send_signal(INTERRUPT)

    def stop(self) -> None:
        """Stop it for good: politely, then by force."""
        self.cancel()
        try:
            self._popen.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self._popen.kill()
            self._popen.wait()
        for thread in self._threads:
            thread.join(PATIENCE)  # what it said last is being read


def _read(stream: IO[str], take: Callable[[str], object]) -> None:
    with stream:
        for line in stream:
            take(line.rstrip())
