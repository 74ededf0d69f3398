# SPDX-License-Identifier: Apache-2.0
"""Stopping a run with SIGINT or SIGTERM."""

from __future__ import annotations

import _thread
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from ..events import Message, Reporter

PATIENCE = 10.0  # [s] for which a step that runs is waited for


class PatientStop(threading.Event):
    """A wish to stop between two steps.

    Args:
        patience: seconds after which the main thread is interrupted, unless it obeys; None for never.
    """

    def __init__(self, patience: float | None) -> None:
        super().__init__()
        self._timer: threading.Timer | None = None
        if patience is not None:
            self._timer = threading.Timer(patience, _thread.interrupt_main)
            self._timer.daemon = True

    def ask(self) -> None:
        """Wish it, and begin to wait."""
        self.set()
        if self._timer:
            self._timer.start()

    def obeyed(self) -> None:
        """End the waiting: no step runs any more, and what follows must not be interrupted."""
        if self._timer:
            self._timer.cancel()


@contextmanager
def stop_on_signals(report: Reporter, patience: float | None = None) -> Iterator[PatientStop]:
    """Yield a stop that SIGINT and SIGTERM ask for; a second signal acts immediately.

    Args:
        report: is told of the signal at once.
        patience: of the stop.
    """
    stop = PatientStop(patience)
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    text = "stopping as soon as the step that runs is done; interrupt again to stop at once"

    def ask(number: int, frame: object) -> None:
        signal.signal(signal.SIGTERM, before[signal.SIGTERM])
        signal.signal(signal.SIGINT, signal.default_int_handler)  # also where a shell had SIGINT ignored
        stop.ask()
        # From a thread: the handler may have interrupted a report.
        threading.Thread(target=report, args=(Message(text),), daemon=True).start()

    for number in before:
        signal.signal(number, ask)
    try:
        yield stop
    finally:
        stop.obeyed()
        for number, handler in before.items():
            signal.signal(number, handler)
