# SPDX-License-Identifier: GPL-3.0-or-later
"""A piece of work: steps in Blender, commands outside it, and steps again; progress, and how it ended."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from ssilk_core.errors import SsilkError
from ssilk_core.events import Failed, Message, Progress, Result, format_seconds, read_event

from ..errors import SetupError
from .process import Process

Command = Sequence[str]
SLICE = 0.04  # seconds that Blender waits for steps at a time


class Work:
    """Steps, then commands one after another in a temporary folder of their own, which goes with `close`, then steps.

    Attributes:
        title: what is being done, for people.
        folder: where the commands run.
        text, fraction: the latest message, and the part that is done or None.
        result: fields of the last `result` event.
        error: one sentence when it failed, else empty.
        cancelled: whether `cancel` was called.
    """

    def __init__(
        self,
        title: str,
        commands: Callable[[Path], Sequence[Command]],
        *,
        parent: str = "",
        steps: Iterator[float] | None = None,
        closing: Iterator[float] | None = None,
        rephrase: Callable[[str], str] = str,
    ) -> None:
        """Prepare the steps; without any prepare the commands, given the temporary folder, and start the first one.

        Args:
            commands: writes what the commands read, and returns them; the folder goes if it raises.
            parent: where the folder is made; the system's place for temporary files when empty.
            steps: are done in this process first, for a moment in each `poll`; they yield the part that is done.
            closing: are done likewise once all commands have succeeded.
            rephrase: turns messages into words for people, without the folder's paths.
        """
        self.title, self.text, self.error = title, "", ""
        self._since = time.monotonic()
        self.fraction: float | None = None
        self.result: dict[str, Any] = {}
        self.cancelled = False
        self._temporary = tempfile.TemporaryDirectory(prefix="ssilk-", dir=parent or None)
        self.folder = Path(self._temporary.name)
        self._process: Process | None = None
        self._commands, self._waiting = commands, list[Command]()
        self._steps, self._closing, self._rephrase = steps, closing, rephrase
        try:
            if steps is None:
                self._begin()
        except BaseException:
            self.close()
            raise

    @property
    def share(self) -> str:
        """How far it is in a few letters, which no bar cuts off: the part, else how long it has run."""
        if self.cancelled:
            return ""
        if self.fraction is not None:
            return f"{self.fraction:.0%}"
        seconds = int(time.monotonic() - self._since)
        return format_seconds(seconds) if seconds else ""

    @property
    def status(self) -> str:
        """What is done and how far it is, in one line; how long it has run where the part that is done is unknown."""
        if self.cancelled:
            return f"{self.title}: stopping"
        return f"{self.title}: {self.share}" if self.share else self.title

    def poll(self) -> bool:
        """Do some steps, or take in what was said meanwhile; return whether everything has ended."""
        if self._steps is not None:
            self._step(self._steps)
        if self._process is None:
            return self._steps is None
        running = self._process.running
        for line in self._process.lines():
            self._hear(line)
        if running:
            return False
        self._end(self._process)
        return self._process is None and self._steps is None

    def cancel(self) -> None:
        """Ask the running command to stop; `poll` says when it has."""
        self.cancelled = True
        if self._process:
            self._process.cancel()

    def close(self) -> None:
        """Stop what still runs and remove the folder."""
        if self._process:
            self._process.stop()
            self._process = None
        self._temporary.cleanup()

    def _step(self, steps: Iterator[float]) -> None:
        """Do steps for a moment; after the last one start the commands, unless these have been."""
        until, first = time.monotonic() + SLICE, steps is not self._closing
        try:
            if self.cancelled:
                raise SetupError(f"{self.title} was cancelled.")
            for self.fraction in steps:
                if time.monotonic() >= until:
                    return
            self._steps = self.fraction = None
            if first:
                self._begin()
        except SsilkError as error:
            self._steps, self.error = None, str(error)

    def _begin(self) -> None:
        self._waiting = list(self._commands(self.folder))
        self._go_on()

    def _hear(self, line: str) -> None:
        try:
            event = read_event(line)
        except ValueError:  # another program speaks, such as pip
            event = Message(line.strip())
        match event:
            case Message():
                self.text = self._rephrase(event.text) or self.text
            case Progress() if event.total > 0:
                self.fraction = min(max(event.done / event.total, 0.0), 1.0)
            case Result():
                self.result = event.detail
            case Failed():
                self.text = self.error = self._rephrase(event.error)

    def _end(self, process: Process) -> None:
        self._process = None
        if self.cancelled:
            self.error = f"{self.title} was cancelled."
        elif process.exit_code:
            reason = process.complaint or f"the command ended with code {process.exit_code}"
            self.error = self.error or f"{self.title} failed: {self._rephrase(reason)}"
        else:
            self._go_on()

    def _go_on(self) -> None:
        """Start the next command; after the last one do the closing steps."""
        if not self._waiting:
            self._steps = self._closing
            return
        command = self._waiting.pop(0)
        try:
            self._process = Process(command, self.folder)
        except OSError as error:
            self.error = f"{command[0]} cannot be started ({error.strerror or error}); choose another Python."
