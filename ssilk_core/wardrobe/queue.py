# SPDX-License-Identifier: Apache-2.0
"""Commands side by side, each a process of its own, one at a time in each slot."""

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

from ..events import Failed, Result, TaskEvent, read_event

Slot = Mapping[str, str]  # environment variables that give a task its device
Take = Callable[[], "CommandTask | None"]
LOOK = 0.2  # seconds between two looks at whether to stop


@dataclass(frozen=True)
class CommandTask:
    """A command, the folder to run it in, and the log of all that it prints.

    Lines that it prints are events as `events.JsonReporter` writes them; other lines go to the log alone.
    """

    name: str
    command: Sequence[str]
    folder: Path
    log: Path


@dataclass(frozen=True)
class End:
    """How a task ended: its exit code (negative for a signal), its time [s], and the last `Result` it reported."""

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
    """Runs tasks, as many at once as there are slots.

    Args:
        tell: called with a task's name and each of its events; a task that dies without a `Failed` is given one.
        ended: called with a task's name and how it ended.
    """

    def __init__(
        self, slots: Sequence[Slot], tell: Callable[[str, TaskEvent], None], ended: Callable[[str, End], None]
    ) -> None:
        self._free, self.tell, self.ended = deque(slots), tell, ended
        self._running: dict[str, _Running] = {}
        self._heard: queue.Queue[tuple[str, TaskEvent | None]] = queue.Queue()

    def run(self, take: Take, stop: threading.Event) -> None:
        """Run tasks until none is left.

        Whatever else ends this call, such as a second interrupt, kills the tasks that run.

        Args:
            take: returns the next task, or None where none can begin now. It is called whenever a slot is free, and
                again after each event, as long as any task runs.
            stop: once it is set, no task begins, and those that run are asked to stop.
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
        """Pass on what a process prints; in a thread of its own."""
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
        """Wait a moment for an event, and pass it on."""
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
        if code and not running.explained and not running.stopping:
            how = f"signal {-code}" if code < 0 else f"exit code {code}"
            self.tell(task.name, Failed(f"{task.log}: it ended by {how}; the last lines of this log say more."))
        self._free.append(running.slot)
        self.ended(task.name, End(code, time.monotonic() - running.began, running.result))
