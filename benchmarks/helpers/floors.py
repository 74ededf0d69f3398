# SPDX-License-Identifier: Apache-2.0
"""A part of a training step, and the least that it can cost.

A floor counts every input read once and every output written once, and the operations of the method at hand.
Backward, inputs and the gradients of outputs are read and the gradients of inputs are written, with twice the
operations; an energy's gradient can be formed along with its value, so that nothing is read again. Topology, a few
bytes for each vertex whose positions take kilobytes, is left out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from .clock import Rates

Tensors = tuple[Tensor, ...]

WARM, WINDOWS = "warm", "windows"  # phases of a training


@dataclass(frozen=True)
class Floor:
    """The fewest bytes moved and operations done."""

    bytes: float
    operations: float

    def time(self, rates: Rates) -> float:
        """Return the least time [ms] at measured rates."""
        return 1000 * max(self.bytes / rates.copy, self.operations / rates.product)


@dataclass(frozen=True, eq=False, kw_only=True)
class Part:
    """One part of a training step.

    Attributes:
        run: does it and returns what it makes, frames or rows last.
        reads: what it must read.
        leaves: what gets a gradient; without any, there is no backward pass.
        operations: of the forward pass.
        energy: whether it returns energies, whose gradient is formed along with them.
        phases: whose steps have it.
        captured: whether a CUDA graph can hold it.
    """

    name: str
    run: Callable[[], Tensor | Tensors]
    reads: Tensors
    operations: float = 0.0
    leaves: Tensors = ()
    energy: bool = False
    phases: tuple[str, ...] = (WARM, WINDOWS)
    captured: bool = True

    def made(self) -> Tensors:
        """Run and return the outputs as a tuple."""
        outputs = self.run()
        return (outputs,) if isinstance(outputs, Tensor) else tuple(outputs)

    def with_backward(self) -> Callable[[], object]:
        """Return what does the part and its backward pass, both, as a graph cannot go back through what it lacks."""
        gradients = [torch.full_like(output, 1 / output.shape[-1]) for output in self.made()]
        return lambda: torch.autograd.grad(self.made(), self.leaves, gradients)

    def floors(self) -> tuple[Floor, Floor]:
        """Return the floor of the part alone, and that of the part and its backward pass."""
        passing, leaves = size(self.reads) + size(self.made()), size(self.leaves)
        again = 0 if self.energy else passing
        both = Floor(passing + again + leaves, 3 * self.operations)
        return Floor(passing, self.operations), both


def size(values: Iterable[Tensor]) -> int:
    """Return the bytes of tensors."""
    return sum(value.numel() * value.element_size() for value in values)
