# SPDX-License-Identifier: GPL-3.0-or-later
"""A command that is told messages while it runs, and answers in others; threads write and read, so nothing waits.

It ends with its input: when it is closed, or when Blender ends in whatever way.
"""

from __future__ import annotations

import queue
import subprocess
import threading
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import IO, BinaryIO

from ssilk_core.delivery.live.messages import LiveMessage, read_message

from .process import LAST_WORDS, started

PATIENCE = 5.0  # seconds that threads have to end after their process


class Conversation:
    """A running command that speaks in messages."""

    def __init__(self, command: Sequence[str], folder: Path) -> None:
        """Start `command` in `folder`; raise `OSError` if it cannot be started."""
        self._popen = started(
            command, folder, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )  # fmt: skip
        self._unsent: queue.SimpleQueue[LiveMessage | None] = queue.SimpleQueue()
        self._heard: queue.SimpleQueue[LiveMessage] = queue.SimpleQueue()
        self._complaints: deque[str] = deque(maxlen=LAST_WORDS)
        self._unreadable = ""
        works = (
            (self._write, self._popen.stdin),
            (self._read, self._popen.stdout),
            (self._listen, self._popen.stderr),
        )
        self._threads = [threading.Thread(target=work, args=(stream,), daemon=True) for work, stream in works]
        for thread in self._threads:
            thread.start()

    @property
    def pid(self) -> int:
        """The number of its process."""
        return self._popen.pid

    def send(self, message: LiveMessage) -> None:
        """Say something, sooner or later; nothing where it has ended."""
        self._unsent.put(message)

    def heard(self) -> list[LiveMessage]:
        """Return what it has said since the last call."""
        found = []
        while not self._heard.empty():
            found.append(self._heard.get())
        return found

    @property
    def ending(self) -> str:
        """Why it has ended, in a sentence; empty while it runs, or has said what is still being read."""
        if self._unreadable:
            return f"its answer cannot be read: {self._unreadable}."
        if self._popen.poll() is None or any(thread.is_alive() for thread in self._threads[1:]):
            return ""
        last = next((line for line in reversed(self._complaints) if line), "")
        return last.removeprefix("error: ") or f"its process ended with code {self._popen.returncode}."

    def close(self) -> None:
        """End it at once: it writes nothing that could be left half done."""
        self._popen.kill()
        self._popen.wait()
        self._unsent.put(None)
        for thread in self._threads:
            thread.join(PATIENCE)

    def _write(self, stream: IO[bytes]) -> None:
        try:
            with stream:
                while (message := self._unsent.get()) is not None:
                    stream.write(message.to_bytes())
                    stream.flush()
        except OSError:  # it has ended, and `ending` says why
            return

    def _read(self, stream: BinaryIO) -> None:
        with stream:
            try:
                while (message := read_message(stream)) is not None:
                    self._heard.put(message)
            except ValueError as error:
                self._unreadable = str(error)

    def _listen(self, stream: IO[bytes]) -> None:
        with stream:
            for line in stream:
                self._complaints.append(line.decode("utf-8", "replace").rstrip())
