# SPDX-License-Identifier: Apache-2.0
"""A bound on the memory that a file may take while it is read: a few bytes can declare arrays of any size."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

MOST = 3 << 30  # bytes; a character of a million vertices takes a fifth of it


@contextmanager
def bounded_memory(most: int = MOST) -> Iterator[None]:
    """Let this process take at most `most` bytes more than it has; USD and numpy then refuse what does not fit.

    Where the system knows no such bound (all but Linux), and within another one, nothing changes.
    """
    if not sys.platform.startswith("linux"):
        yield
        return
    import resource

    # Addresses (RLIMIT_AS) would be the wrong bound: USD's threads reserve some for each core of a machine.
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    pages = int(Path("/proc/self/statm").read_text().split()[5])
    bound = pages * resource.getpagesize() + most
    if soft != resource.RLIM_INFINITY and soft <= bound:
        yield
        return
    resource.setrlimit(resource.RLIMIT_DATA, (bound, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))
