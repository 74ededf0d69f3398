# SPDX-License-Identifier: Apache-2.0
"""Functions of frames as CUDA graphs: a GPU gets all tasks of one at once.

An energy, its gradient and its Hessian are some hundred small tasks, and a GPU is done with each before its host has
asked for the next. Graphs are captured for numbers of frames that are powers of two. Frames beyond those that are
given are computed, too, and thrown away: no frame depends on another.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from .framed import Framed

LEAST, MOST = 8, 512  # frames of a graph; with more the tasks keep a GPU busy by themselves


def replays(x: Tensor) -> bool:
    """Return whether functions of positions x (V, 3, N) are captured: on a GPU, without gradients, for few frames."""
    if x.device.type != "cuda" or x.requires_grad or not 0 < x.shape[-1] <= MOST:
        return False
    return not torch.cuda.is_current_stream_capturing()


def rounded_up(frames: int) -> int:
    """Return the frames of the graph for a number of frames."""
    return max(LEAST, 1 << (frames - 1).bit_length())


def captured(work: Callable[[], object], device: torch.device, pool: Any = None) -> torch.cuda.CUDAGraph:
    """Return the graph of some work, which a GPU does twice: kernels are compiled first, and libraries begin."""
    with torch.cuda.device(device):
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            work()
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, pool=pool):
            work()
    return graph


class Captured:
    """A function of values of N frames, each a tensor with the frames last, a `Framed` one without tuples, or None.

    It returns tensors with the frames last. What frames share must stay as it is in between calls.
    """

    def __init__(self, function: Callable[..., Sequence[Tensor]]) -> None:
        self._function = function
        self._graphs: dict[Hashable, _Graph] = {}
        self._pool: Any = None

    def __call__(self, *given: Tensor | Framed | None) -> list[Tensor]:
        """Return what the function does."""
        leaves = [leaf for value in given for leaf in _leaves(value)]
        frames = leaves[0].shape[-1]
        capacity = rounded_up(frames)
        key = capacity, *map(_kind, given)
        if key not in self._graphs:
            # What graphs leave behind may share memory, since results are copied before another one runs.
            self._pool = self._pool or torch.cuda.graph_pool_handle()
            order = torch.arange(capacity, device=leaves[0].device) % frames
            own = [leaf[..., order].contiguous() for leaf in leaves]
            at = iter(own)
            self._graphs[key] = _Graph(self._function, [_like(value, at) for value in given], own, self._pool)
        return self._graphs[key](leaves, frames)


class _Graph:
    """A graph with the memory that it reads."""

    def __init__(self, function: Callable[..., Sequence[Tensor]], given: Sequence[Any], own: list[Tensor], pool: Any):
        self._own, self._given = own, given  # which keep alive what the frames share

        def work() -> None:
            self._found = function(*given)

        self._graph = captured(work, own[0].device, pool)

    def __call__(self, leaves: Sequence[Tensor], frames: int) -> list[Tensor]:
        for own, leaf in zip(self._own, leaves, strict=True):
            own[..., :frames].copy_(leaf)
        self._graph.replay()
        return [each[..., :frames].clone(memory_format=torch.contiguous_format) for each in self._found]


def _leaves(value: Any) -> list[Tensor]:
    """Return the tensors of a value that have frames."""
    if isinstance(value, Tensor):
        return [value]
    return [leaf for own in value.own().values() for leaf in _leaves(own)] if isinstance(value, Framed) else []


def _like(value: Any, leaves: Iterator[Tensor]) -> Any:
    """Return a value with other tensors."""
    if isinstance(value, Tensor):
        return next(leaves)
    if isinstance(value, Framed):
        return replace(value, **{name: _like(own, leaves) for name, own in value.own().items()})  # type: ignore[type-var]
    return value


def _kind(value: Any) -> Hashable:
    """Return what values have in common that one graph serves."""
    if isinstance(value, Tensor):
        return value.shape[:-1], value.dtype
    if isinstance(value, Framed) and not any(isinstance(own, tuple) for own in value.own().values()):
        shared = (getattr(value, name) for name in sorted(value.SHARED))
        return (
            type(value),
            *map(_kind, value.own().values()),
            *(each.data_ptr() if isinstance(each, Tensor) else each for each in shared),
        )
    if not (value is None or isinstance(value, (int, float))):  # a graph would keep what this one holds
        raise TypeError(f"no graph can be captured of a {type(value).__name__}")
    return value
