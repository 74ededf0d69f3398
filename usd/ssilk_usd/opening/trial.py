# SPDX-License-Identifier: Apache-2.0
"""Reading first in a process of its own: a hostile file may crash that one, or keep it for ever.

USD itself ends the process, or never returns, for some damaged and some tiny hostile files. A server, started with
the first reading, forks a process for each trial. This process cannot fork by itself: USD's threads may hold locks,
which nobody would open in the fork.
"""

from __future__ import annotations

import os
import pickle
import select
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from importlib import import_module
from pathlib import Path
from typing import Any

from ssilk_core.errors import fail

from . import memory
from .memory import HOST, allowed_gib, positive_setting

VARIABLE, USUAL = "SSILK_READ_SECONDS", 30.0
_READERS = ("reading.motion", "reading.scene", "reading.shapes", "reading.visibility", "reading.frame_range",
            "shots.read", "writing.repair")  # fmt: skip
_IMPORTS = ", ".join(f"ssilk_usd.{name}" for name in (*_READERS, "opening.trial"))
# Without threads of USD's own in the server, none is missing in its forks, and no lock stays locked in them. Its
# schemas are read once, which each trial would do for itself otherwise, in half of its time.
_SERVE = (
    "from pxr import Usd, Work; Work.SetConcurrencyLimit(1); "
    f"import {_IMPORTS}; Usd.SchemaRegistry(); ssilk_usd.opening.trial.serve()"
)
_HEADER = struct.Struct("<Qd")  # of a request: its size [bytes], and for how long it may compute [s]
_LOOK = 1.0  # [s] between looks at whether a process still computes
_within = ContextVar("_within", default=False)
_lock = threading.Lock()
_server: tuple[int, subprocess.Popen[bytes]] | None = None  # of the process with this number


def allowed_seconds() -> float:
    """Return for how many seconds reading may compute: from the environment, else the default."""
    return positive_setting(VARIABLE, USUAL, "seconds")


@contextmanager
def tried(read: Callable[..., object], *args: Any, **options: Any) -> Iterator[str]:
    """Call a function in a process of its own; yield what ended it, or nothing ("") where it returned or raised.

    Within the context nothing is tried again. Nothing is tried on systems whose limits are not known (all but Linux),
    and inside Blender, which reads what the artist opened.

    Args:
        read: a function of a module, by whose name the other process finds it.
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

    Raises:
        SsilkError: the server does not answer.
    """
    seconds = allowed_seconds()
    call = read.__module__, read.__qualname__, args, options
    content = pickle.dumps((seconds, allowed_gib(), os.getcwd(), *call))
    with _lock:
        status = _asked(_HEADER.pack(len(content), seconds) + content)
    if not os.WIFSIGNALED(status):
        return ""
    number = os.WTERMSIG(status)
    if number in (signal.SIGPROF, signal.SIGALRM):
        return f"reading it {'takes' if number == signal.SIGPROF else 'waits'} more than {seconds:g} s"
    return f"reading it ends the process by signal {number} ({signal.Signals(number).name})"


def _asked(request: bytes) -> int:
    """Return the status in which the process of a trial ended, as `os.waitpid` returns it."""
    for _ in range(2):  # somebody may have killed the server
        answer = b""
        server = _running()
        assert server.stdin and server.stdout
        try:
            server.stdin.write(request)
            server.stdin.flush()
            import_module("pxr.UsdSkel")  # meanwhile: whoever has tried it reads it next
            answer = server.stdout.readline()
        except BrokenPipeError:
            continue
        finally:
            if not answer:  # Ctrl-C, too: the next answer would be one to this request
                server.kill()
                server.wait()
        if answer:
            return int(answer)
    return fail("reading", "the process that reads first was killed twice", "it must live on", "is memory short?")


def _running() -> subprocess.Popen[bytes]:
    """Return this process's server, started where there is none."""
    global _server
    if _server is None or _server[0] != os.getpid() or _server[1].poll() is not None:
        paths = os.pathsep.join(filter(None, sys.path))
        # -P: modules that lie in the working folder are none of ours.
        _server = (
            os.getpid(),
            subprocess.Popen(
                [sys.executable, "-P", "-c", _SERVE],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env={**os.environ, "PYTHONPATH": paths},
            ),
        )
    return _server[1]


def stop() -> None:
    """End the server, if there is one; the next trial starts another."""
    global _server
    with _lock:
        if _server and _server[0] == os.getpid():
            _server[1].communicate()
        _server = None


def serve() -> None:
    """Answer requests on standard input until it ends."""
    for number in (signal.SIGINT, signal.SIGTERM):  # they are for the process that asks
        signal.signal(number, signal.SIG_IGN)
    source, answers = sys.stdin.buffer, os.dup(1)
    silence = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):  # what USD prints is raised where it is read again
        os.dup2(silence, stream)
    while header := source.read(_HEADER.size):
        size, seconds = _HEADER.unpack(header)
        request = source.read(size)
        child = os.fork()
        if child == 0:
            _read_and_exit(request)
        os.write(answers, b"%d\n" % _ended(child, seconds))


def _ended(child: int, seconds: float) -> int:
    """Wait for a process, and end it once it has not computed for some seconds; return its status."""
    handle, used, since = os.pidfd_open(child), -1, time.monotonic()
    while not select.select([handle], [], [], _LOOK)[0]:
        now = sum(map(int, Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()[11:13]))
        if now > used:
            used, since = now, time.monotonic()
        elif time.monotonic() - since > seconds:
            os.kill(child, signal.SIGALRM)
    os.close(handle)
    return os.waitpid(child, 0)[1]


def _read_and_exit(request: bytes) -> None:
    """Read within the seconds that the request allows; end this process."""
    with suppress(BaseException):  # the caller reads again, and meets it where it can be told
        import resource

        from pxr import Work

        # From the process that started this one; what lies in files is never unpickled.
        seconds, gib, folder, module, name, args, options = pickle.loads(request)
        os.chdir(folder)
        os.environ[memory.VARIABLE] = str(gib)
        _within.set(True)
        Work.SetMaximumConcurrencyLimit()
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        signal.setitimer(signal.ITIMER_PROF, seconds)  # of computing, so that busy machines refuse nothing
        getattr(import_module(module), name)(*args, **options)
    os._exit(0)
