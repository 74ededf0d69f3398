# SPDX-License-Identifier: Apache-2.0
"""The processes of a Ray cluster that another process started on this machine (Linux)."""

from __future__ import annotations

import os
from pathlib import Path


def workers(ancestor: int) -> list[int]:
    """Return the processes below `ancestor` that bake at the moment."""
    return [pid for pid, words in _below(ancestor).items() if words[0].startswith(b"ray::_outcome")]


def raylets(ancestor: int) -> list[int]:
    """Return the processes below `ancestor` that start the workers."""
    return [pid for pid, words in _below(ancestor).items() if words[0].endswith(b"/raylet")]


def _below(ancestor: int) -> dict[int, list[bytes]]:
    """Return the words of each process that `ancestor`, or one below it, started."""
    parents, words = {}, {}
    for path in Path("/proc").glob("[0-9]*"):
        try:
            parents[int(path.name)] = int((path / "stat").read_text().rpartition(")")[2].split()[1])
            words[int(path.name)] = (path / "cmdline").read_bytes().split(b"\0")
        except OSError:  # it ended meanwhile
            continue
    return {pid: said for pid, said in words.items() if pid != ancestor and _is_below(pid, ancestor, parents)}


def _is_below(pid: int, ancestor: int, parents: dict[int, int]) -> bool:
    while pid > 1 and pid != ancestor:
        pid = parents.get(pid, 0)
    return pid == ancestor


def resident(pid: int) -> float:
    """Return the memory of a process [MiB]; 0 where it has ended."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20
    except OSError:
        return 0.0
