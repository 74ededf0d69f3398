# SPDX-License-Identifier: Apache-2.0
"""Data-parallel training: several processes train one garment, each on its part of the batch."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor

from ..config import TrainConfig
from ..devices import chosen_device
from ..errors import SsilkError, fail

SHARED = (
    "batch",
    "pretraining_batch",
    "static_batch",
)  # settings that count what one step looks at, in all processes together
LAUNCHED = ("RANK", "LOCAL_RANK", "WORLD_SIZE")  # what torchrun tells each process

Value = TypeVar("Value")


@dataclass(frozen=True)
class ProcessGroup:
    """The processes that train one garment, and this one's place among them; one alone exchanges nothing.

    All hold the same parameters, bit for bit: they start from one seed, and each step uses one averaged gradient.
    What they decide (to keep a model, to stop) they decide from values that all of them have.
    """

    rank: int = 0
    size: int = 1

    @property
    def first(self) -> bool:
        """Whether this is the process that reports and writes files."""
        return self.rank == 0

    def seed(self, seed: int) -> int:
        """Return a seed for this process's own random draws; the first process draws as one alone would."""
        return seed if self.first else int(np.random.SeedSequence((seed, self.rank)).generate_state(1, np.uint64)[0])

    def part(self, config: TrainConfig) -> TrainConfig:
        """Return the settings of one process, each with an equal part of every batch.

        Raises:
            SsilkError: a batch does not divide.
        """
        for name in SHARED:
            value = getattr(config, name)
            if value % self.size != 0:
                fail(
                    f"setting '{name}'",
                    f"{value} for {self.size} processes",
                    "each takes an equal part",
                    f"use a multiple of {self.size}",
                )
        return replace(config, **{name: getattr(config, name) // self.size for name in SHARED})

    def average(self, tensors: list[Tensor]) -> None:
        """Replace tensors by their means over all processes, in one exchange that a CUDA graph can hold.

        Raises:
            SsilkError: another process has ended.
        """
        flat = torch.cat([tensor.reshape(-1) for tensor in tensors])
        with self._others_needed():
            dist.all_reduce(flat)
        parts = flat.div_(self.size).split([tensor.numel() for tensor in tensors])
        torch._foreach_copy_(tensors, [part.view_as(tensor) for part, tensor in zip(parts, tensors)])

    def any(self, flag: bool) -> bool:
        """Return whether the flag of any process is set."""
        return any(self.gather(flag))

    def gather(self, value: Value) -> list[Value]:
        """Return the value of each process, by rank; tensors in it must be on the CPU.

        Raises:
            SsilkError: another process has ended.
        """
        if self.size == 1:
            return [value]
        values = [value] * self.size
        with self._others_needed():
            dist.all_gather_object(values, value)
        return values

    @contextmanager
    def _others_needed(self) -> Iterator[None]:
        try:
            yield
        except RuntimeError as error:
            reason = str(error).partition("\n")[0].partition(". ")[0]
            raise SsilkError(
                f"process {self.rank + 1} of {self.size}: the others cannot be reached ({reason}); see whether one "
                "has said why it ended, then train again with --resume."
            ) from error


SINGLE_PROCESS = ProcessGroup()


@contextmanager
def joined(device: str) -> Iterator[tuple[ProcessGroup, str]]:
    """Join the processes that torchrun has started; yield this one's place among them, and its device.

    Without torchrun, a process is alone on the device that was asked for. Host values travel through gloo, so that
    no exchange of theirs waits for a GPU; gradients on GPUs travel through NCCL.

    Raises:
        SsilkError: a device is asked for by number, or there are fewer GPUs than processes.
    """
    if any(name not in os.environ for name in LAUNCHED) or os.environ["WORLD_SIZE"] == "1":
        yield SINGLE_PROCESS, device
        return
    own = _own_device(device, int(os.environ["LOCAL_RANK"]))
    dist.init_process_group("cpu:gloo,cuda:nccl" if own.type == "cuda" else "gloo")
    group = ProcessGroup(dist.get_rank(), dist.get_world_size())
    yield group, str(own)
    # After an error the others may never come here, and nothing waits for them. Otherwise all leave together, since
    # torchrun ends those that are left, and captured graphs go before the communicator in them, which waits for that.
    group.gather(None)
    gc.collect()
    dist.destroy_process_group()


def _own_device(name: str, local_rank: int) -> torch.device:
    if ":" in name:
        fail(
            f"--device {name}", "torchrun gives each process a GPU of its own", "'auto', 'cuda' and 'cpu' are allowed"
        )
    if name == "cpu" or not torch.cuda.is_available():
        return chosen_device(name)
    count = torch.cuda.device_count()
    if not local_rank < count:
        fail(
            f"process {local_rank + 1}",
            f"{count} GPUs are visible",
            "each process needs its own",
            f"start with --nproc-per-node {count}",
        )
    torch.cuda.set_device(local_rank)  # kernels and graphs run on the current device
    return torch.device("cuda", local_rank)
