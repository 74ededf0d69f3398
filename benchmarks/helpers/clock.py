# SPDX-License-Identifier: Apache-2.0
"""Time work on a device: CUDA events around graph replays, or a processor's clock around calls."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch

FLUSHED = 256 << 20  # bytes written before each repeat: more than any cache of a device
FEWEST, MOST = 5, 50  # repeats
WARM_UP = 3

Work = Callable[[], object]


@dataclass(frozen=True)
class Span:
    """Time of one call [ms]: median, tenth and ninetieth percentile over the repeats."""

    median: float
    low: float
    high: float
    repeats: int

    @classmethod
    def of(cls, times: list[float]) -> Span:
        low, median, high = np.percentile(times, (10, 50, 90))
        return cls(float(median), float(low), float(high), len(times))


def now(device: torch.device) -> float:
    """Return the time once a device has done its work [s]."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


class Clock:
    """Measures work on one device.

    Args:
        budget: about how long to repeat a piece of work [s].
    """

    def __init__(self, device: torch.device, budget: float) -> None:
        self.on_gpu, self.budget = device.type == "cuda", budget
        self.scratch = torch.empty(FLUSHED if self.on_gpu else 0, dtype=torch.uint8, device=device)

    def work(self, work: Work, *, captured: bool = True, generator: torch.Generator | None = None) -> Span:
        """Time one call of `work`, on the GPU as a graph of its own unless it cannot be `captured`.

        Caches are cold: each part of a training step finds them filled by others.
        """
        if not (self.on_gpu and captured):
            return self.calls(work, flushed=True)
        with _graph(work, generator) as replay:
            return self.calls(replay, flushed=True)

    def calls(self, work: Work, *, flushed: bool = False) -> Span:
        """Time calls of `work` as they are; what they leave to be done on the device counts."""
        for _ in range(WARM_UP - 1):
            work()
        (first,) = self._times(work, 1, flushed)
        repeats = int(np.clip(1000 * self.budget / max(first, 1e-3), FEWEST, MOST))
        return Span.of(self._times(work, repeats, flushed))

    def _times(self, work: Work, repeats: int, flushed: bool) -> list[float]:
        """Return the time of each call [ms]; a GPU is given all of them at once, so that it never waits for work."""
        if not self.on_gpu:
            return [_processor_time(work) for _ in range(repeats)]
        pairs = [[torch.cuda.Event(enable_timing=True) for _ in range(2)] for _ in range(repeats)]
        for begin, end in pairs:
            if flushed:
                self.scratch.zero_()
            begin.record()
            work()
            end.record()
        torch.cuda.synchronize()
        return [begin.elapsed_time(end) for begin, end in pairs]


def _processor_time(work: Work) -> float:
    began = time.perf_counter()
    work()
    return 1000 * (time.perf_counter() - began)


def side_stream(device: torch.device) -> torch.cuda.Stream | None:
    """Return the one stream that everything is built, warmed up and captured on; none without a GPU.

    Autograd runs a node on the stream where it was made, and what is left on the default one breaks any capture.
    """
    return torch.cuda.Stream(device) if device.type == "cuda" else None


@contextmanager
def _graph(work: Work, generator: torch.Generator | None) -> Iterator[Work]:
    """Capture work as a CUDA graph, on `side_stream`, and yield what replays it; in the end its memory is free."""
    for _ in range(WARM_UP):
        work()
    graph = torch.cuda.CUDAGraph()
    if generator is not None:
        graph.register_generator_state(generator)
    with torch.cuda.graph(graph, stream=torch.cuda.current_stream()):
        work()
    yield graph.replay
    graph.reset()


@dataclass(frozen=True)
class Rates:
    """What a machine reaches: bytes read and written by a copy, operations of a float32 matrix product [1/s]."""

    copy: float
    product: float

    @classmethod
    def measured(cls, clock: Clock, device: torch.device) -> Rates:
        count, side = (1 << 28, 8192) if clock.on_gpu else (1 << 24, 1024)
        source = torch.rand(count, device=device)
        target = torch.empty_like(source)
        copied = clock.calls(lambda: target.copy_(source)).median
        a, b = torch.rand(2, side, side, device=device)
        multiplied = clock.calls(lambda: torch.mm(a, b)).median
        return cls(2 * source.nbytes / copied * 1000, 2 * side**3 / multiplied * 1000)
