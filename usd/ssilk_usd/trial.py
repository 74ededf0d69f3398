# SPDX-License-Identifier: Apache-2.0
"""Reading first in a process of its own: a hostile file may crash that one, or keep it for ever.

USD itself ends the process, or never returns, for some damaged and some tiny hostile files. A server, started with
the first reading, forks a process for each trial. This process cannot fork by itself: USD's threads may hold locks,
which nobody would open in the fork.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from typing import Any

from . import memory
from .memory import HOST, allowed_gib, positive_setting

VARIABLE, USUAL = "SSILK_READ_SECONDS", 30.0  # of computing, so that busy machines refuse nothing
WAITING = 4  # times as long may pass in all
_READERS = ("read_motion", "read_scene", "read_shot", "read_visibility", "repair", "frame_range")
_SERVE = f"from ssilk_usd import {', '.join(_READERS)}, trial; trial.serve()"
_within = ContextVar("_within", default=False)
_lock = threading.Lock()
_server: tuple[int, subprocess.Popen[bytes]] | None = None  # of the process with this number


def allowed_seconds() -> float:
    """Return how many seconds of computing reading may take: from the environment, else the default."""
    return positive_setting(VARIABLE, USUAL, "seconds")


@contextmanager
def tried(read: Callable[..., object], *args: Any, **options: Any) -> Iterator[str]:
    """Call a function in a process of its own; yield what ended it, or nothing ("") where it returned or raised.

    Within the context nothing is tried again. Nothing is tried on systems whose limits are not known (all but Linux),
    and inside Blender, which reads what the artist opened.

    Args:
        read: a function of a module, by which the other process finds it.
        args, options: values that can be pickled.
    """
    if _within.get() or not sys.platform.startswith("linux") or HOST in sys.modules:
        yield ""
        return
    token = _within.set(True)
    try:
        yield ending(read, *args, **options)
    finally:
        _within.reset(token)


def ending(read: Callable[..., object], *args: Any, **options: Any) -> str:
    """Call a function in a process of its own; return what ended that, or "" where the function returned or raised.

    Arguments are those of `tried`.
    """
    seconds = allowed_seconds()
    request = seconds, allowed_gib(), os.getcwd(), read, args, options
    with _lock:
        status = _asked(pickle.dumps(request))
    if not os.WIFSIGNALED(status):
        return ""
    number = os.WTERMSIG(status)
    if number in (signal.SIGPROF, signal.SIGALRM):
        return f"reading it takes more than {seconds if number == signal.SIGPROF else WAITING * seconds:g} s"
    return f"reading it ends the process by signal {number} ({signal.Signals(number).name})"


def _asked(request: bytes) -> int:
    """Return the status in which the process of a trial ended, as `os.waitpid` returns it."""
    global _server
    if _server is None or _server[0] != os.getpid() or _server[1].poll() is not None:
        _server = os.getpid(), _started()
    server = _server[1]
    assert server.stdin and server.stdout
    answer = b""
    try:
        server.stdin.write(len(request).to_bytes(8, "little") + request)
        server.stdin.flush()
        answer = server.stdout.readline()
    finally:
        if not answer:  # Ctrl-C, or it was killed: the next answer would be one to this request
            server.kill()
            server.wait()
    return int(answer or signal.SIGKILL)


def _started() -> subprocess.Popen[bytes]:
    paths = os.pathsep.join(filter(None, sys.path))
    return subprocess.Popen(
        [sys.executable, "-c", _SERVE],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": paths},
    )


def stop() -> None:
    """End the server, if there is one; the next trial starts another."""
    global _server
    with _lock:
        if _server and _server[0] == os.getpid():
            _server[1].communicate()
        _server = None


def serve() -> None:
    """Answer requests on standard input until it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the process that asks
    source, answers = sys.stdin.buffer, os.dup(1)
    silence = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):  # what USD prints is raised where it is read again
        os.dup2(silence, stream)
    while size := source.read(8):
        request = source.read(int.from_bytes(size, "little"))
        child = os.fork()
        if child == 0:
            _read_and_exit(request)
        os.write(answers, b"%d\n" % os.waitpid(child, 0)[1])


def _read_and_exit(request: bytes) -> None:
    """Read within the seconds that the request allows; end this process."""
    with suppress(BaseException):  # the caller reads again, and meets it where it can be told
        import resource

        # From the process that started this one; what lies in files is never unpickled.
        seconds, gib, folder, read, args, options = pickle.loads(request)
        os.chdir(folder)
        os.environ[memory.VARIABLE] = str(gib)
        _within.set(True)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        signal.setitimer(signal.ITIMER_PROF, seconds)
        signal.setitimer(signal.ITIMER_REAL, WAITING * seconds)
        read(*args, **options)
    os._exit(0)
