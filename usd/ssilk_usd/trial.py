# SPDX-License-Identifier: Apache-2.0
"""Reading first in a process of its own: a hostile file may crash that one, or keep it for ever.

USD itself ends the process, or never returns, for some damaged and some tiny hostile files. A fork reads the same
bytes from the same memory, so what it survives the caller survives too.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar

from .memory import HOST, positive_setting

VARIABLE, USUAL = "SSILK_READ_SECONDS", 30.0  # of computing, so that busy machines refuse nothing
WAITING = 4  # times as long may pass in all
_within = ContextVar("_within", default=False)


def allowed_seconds() -> float:
    """Return how many seconds of computing reading may take: from the environment, else the default."""
    return positive_setting(VARIABLE, USUAL, "seconds")


@contextmanager
def tried(read: Callable[[], object]) -> Iterator[str]:
    """Call `read` in a fork; yield what ended it, or nothing ("") where it returned or raised.

    Within the context, and within the fork, nothing is tried again. Nothing is tried where processes cannot fork
    safely (all but Linux), and inside Blender, which reads what the artist opened.
    """
    if _within.get() or not sys.platform.startswith("linux") or HOST in sys.modules:
        yield ""
        return
    token = _within.set(True)
    try:
        yield _ending(read, allowed_seconds())
    finally:
        _within.reset(token)


def _ending(read: Callable[[], object], seconds: float) -> str:
    child = os.fork()
    if child == 0:
        _read_and_exit(read, seconds)
    try:
        status = os.waitpid(child, 0)[1]
    except BaseException:  # Ctrl-C: do not leave it behind
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        raise
    if not os.WIFSIGNALED(status):
        return ""
    number = os.WTERMSIG(status)
    if number in (signal.SIGPROF, signal.SIGALRM):
        return f"reading it takes more than {seconds if number == signal.SIGPROF else WAITING * seconds:g} s"
    return f"reading it ends the process by signal {number} ({signal.Signals(number).name})"


def _read_and_exit(read: Callable[[], object], seconds: float) -> None:
    """Read, without a word and within `seconds` of computing; end this process."""
    with suppress(BaseException):  # the caller reads again, and meets it where it can be told
        import faulthandler
        import resource

        faulthandler.disable()
        silence = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silence, 1)
        os.dup2(silence, 2)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        for number in (signal.SIGPROF, signal.SIGALRM, signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_PROF, seconds)
        signal.setitimer(signal.ITIMER_REAL, WAITING * seconds)
        read()
    os._exit(0)
