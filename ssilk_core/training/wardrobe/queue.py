# SPDX-License-Identifier: Apache-2.0
"""Run commands in parallel, each in its own process, one at a time per slot."""

from __future__ import annotations

import os
import queue
import signal
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from ...errors import EXIT_INTERRUPTED, EXIT_OK, EXIT_WORSE
from ...events import Failed, Result, TaskEvent, read_event

Slot = Mapping[str, str]  # environment variables that give a task its device
Take = Callable[[], "CommandTask | None"]
LOOK = 0.2  # [s] interval between two checks of whether to stop


@dataclass(frozen=True)
class CommandTask:
    """A command, its working folder, and the log of its output.

    The command prints events as `events.JsonReporter` writes them. Other lines only go to the log.
    """

    name: str
    command: Sequence[str]
    folder: Path
    log: Path


@dataclass(frozen=True)
class End:
    """The end of a task: exit code (negative for a signal), duration [s], and the last `Result` that it reported."""

    code: int
    seconds: float
    result: Result | None


@dataclass
class _Running:
    task: CommandTask
    slot: Slot
    process: subprocess.Popen[str]
    began: float = field(default_factory=time.monotonic)
    result: Result | None = None
    explained: bool = False
    stopping: bool = False

    def hear(self, event: TaskEvent) -> None:
        if isinstance(event, Result):
            self.result = event
        self.explained |= isinstance(event, Failed)

    def stop(self) -> None:
        if not self.stopping:
            self.stopping = True
            self.process.send_signal(signal.SIGINT)


class Queue:
    """Runs tasks in parallel, one per slot.

    Args:
        tell: called with a task's name and each of its events, and with a `Failed` if a task dies without one.
        ended: called with a task's name and its end.
    """

    def __init__(
        self, slots: Sequence[Slot], tell: Callable[[str, TaskEvent], None], ended: Callable[[str, End], None]
    ) -> None:
        self._free, self.tell, self.ended = deque(slots), tell, ended
        self._running: dict[str, _Running] = {}
        self._heard: queue.Queue[tuple[str, TaskEvent | None]] = queue.Queue()

    def run(self, take: Take, stop: threading.Event) -> None:
        """Run tasks until none is left.

        An exception in this call, such as a second interrupt, kills the running tasks.

        Args:
            take: returns the next task, or None if none can start now. It is called when a slot is free, and again
                after each event while any task runs.
            stop: once set, no further task starts, and running tasks are asked to stop.
        """
        try:
            while True:
                while self._free and not stop.is_set() and (task := take()):
                    self._start(task)
                if not self._running:
                    return
                if stop.is_set():
                    for running in self._running.values():
                        running.stop()
                self._listen()
        finally:
            for running in self._running.values():
                running.process.kill()

    def _start(self, task: CommandTask) -> None:
        slot = self._free.popleft()
        with open(task.log, "a", encoding="utf-8") as log:
            process = subprocess.Popen(
                task.command,
                cwd=task.folder,
                env={**os.environ, **slot},
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                encoding="utf-8",
                start_new_session=True,  # a terminal interrupts this process alone, which passes it on
            )
        self._running[task.name] = _Running(task, slot, process)
        threading.Thread(target=self._read, args=(task, process), daemon=True).start()

    def _read(self, task: CommandTask, process: subprocess.Popen[str]) -> None:
        """Forward the output of a process; runs in its own thread."""
        assert process.stdout is not None
        with open(task.log, "a", encoding="utf-8") as log:
            for line in process.stdout:
                log.write(line)
                log.flush()
                try:
                    self._heard.put((task.name, read_event(line)))
                except ValueError:
                    continue  # a library's own words, for the log only
        self._heard.put((task.name, None))

    def _listen(self) -> None:
        """Wait briefly for an event, and forward it."""
        try:
            name, event = self._heard.get(timeout=LOOK)
        except queue.Empty:
            return
        if event is None:
            self._end(self._running.pop(name))
        else:
            self._running[name].hear(event)
            self.tell(name, event)

    def _end(self, running: _Running) -> None:
        code, task = running.process.wait(), running.task
        if running.stopping and code == -signal.SIGINT:  # it was not yet listening
            code = EXIT_INTERRUPTED
        if code not in (EXIT_OK, EXIT_WORSE) and not running.explained and not running.stopping:
            how = f"signal {-code}" if code < 0 else f"exit code {code}"
            self.tell(task.name, Failed(f"{task.log}: it ended by {how}; the last lines of this log say more."))
        self._free.append(running.slot)
        self.ended(task.name, End(code, time.monotonic() - running.began, running.result))
