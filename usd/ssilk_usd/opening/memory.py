# SPDX-License-Identifier: Apache-2.0
"""A bound on the memory that a file may take while it is read: a few bytes can declare arrays of any size."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ssilk_core.errors import fail

VARIABLE, USUAL = "SSILK_READ_GIB", 0.75  # GiB; a character of a million vertices takes 0.6
HOST = "bpy"  # Blender's own module
STACK = 8 << 20  # bytes of each thread that USD may start meanwhile


def allowed_gib() -> float:
    """Return how many GiB reading may take: from the environment, else the default."""
    return positive_setting(VARIABLE, USUAL, "GiB")


def positive_setting(variable: str, usual: float, unit: str) -> float:
    """Return a positive number from the environment, `usual` where it is not set; raise `SsilkError` for others."""
    text = os.environ.get(variable, str(usual))
    try:
        number = float(text)
    except ValueError:
        number = 0.0
    if not 0 < number < 1e6:
        fail(variable, f"'{text}'", f"a number of {unit} is needed", "correct it in the environment")
    return number


@contextmanager
def bounded_memory(gib: float | None = None) -> Iterator[None]:
    """Limit how much more memory this process may take; USD and numpy then refuse what does not fit.

    Nothing changes where the system has no such bound (all but Linux), within a smaller bound, and inside Blender,
    whose other threads would meet the bound too.
    """
    if not sys.platform.startswith("linux") or HOST in sys.modules:
        yield
        return
    import resource

    # Addresses (RLIMIT_AS) would be the wrong bound: USD's threads reserve some for each core of a machine.
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    pages = int(Path("/proc/self/statm").read_text().split()[5])
    most = int((gib or allowed_gib()) * 2**30) + STACK * (os.cpu_count() or 1)
    bound = pages * resource.getpagesize() + most
    if soft != resource.RLIM_INFINITY and soft <= bound:
        yield
        return
    resource.setrlimit(resource.RLIMIT_DATA, (bound, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))
