# SPDX-License-Identifier: Apache-2.0
"""How loops are distributed over threads.

Loops release Python's lock, so that ordinary threads run them side by side. numba's own threads are left out: they
compile three times as long, differ between systems, and do not survive a fork. What a loop writes does not depend on
how its range is split, so results are the same for any number of threads.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor

_pools: dict[int, ThreadPoolExecutor] = {}
_lent: list[int] = []  # threads that PyTorch leaves to loops
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pools.clear)  # a child has none of the threads


@contextmanager
def all_threads() -> Iterator[None]:
    """Give all of PyTorch's threads to loops, and one to PyTorch: small operations are done sooner than shared."""
    threads = torch.get_num_threads()
    _lent.append(threads)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        _lent.pop()


def run_parts(loop: Callable[..., Any], count: int, *arguments: object) -> None:
    """Call `loop(*arguments, start, stop)` for parts of range(count), one for each of PyTorch's threads."""
    threads = min(_lent[-1] if _lent else torch.get_num_threads(), count)
    if threads < 2:
        loop(*arguments, 0, count)
        return
    if threads not in _pools:
        _pools[threads] = ThreadPoolExecutor(threads - 1, "loops")
    edges = [part * count // threads for part in range(threads + 1)]
    others = [_pools[threads].submit(loop, *arguments, *edge) for edge in pairwise(edges[1:])]
    loop(*arguments, *edges[:2])
    for other in others:
        other.result()


def array(values: Tensor) -> np.ndarray:
    """Return a tensor's values as a contiguous array, which shares its memory where it is contiguous itself."""
    return values.detach().contiguous().numpy()


def blocks_of(frames: int, lanes: int) -> int:
    """Return how many blocks of so many `lanes` hold so many frames."""
    return -(-frames // lanes)
