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

from ..devices import select_device
from ..errors import SsilkError, fail
from .settings import TrainConfig

BATCH_SETTINGS = ("batch", "pretraining_batch", "static_batch")  # totals over all processes
TORCHRUN_VARIABLES = ("RANK", "LOCAL_RANK", "WORLD_SIZE")

Value = TypeVar("Value")


@dataclass(frozen=True)
class ProcessGroup:
    """The processes that train one garment, and this process's rank; a single process communicates nothing.

    All hold the same parameters, bit for bit: they start from one seed, and each step uses one averaged gradient.
    Decisions, such as to keep a model or to stop, depend only on values that all processes share.
    """

    rank: int = 0
    size: int = 1

    @property
    def is_first(self) -> bool:
        """Whether this is the process that reports and writes files."""
        return self.rank == 0

    def seed(self, seed: int) -> int:
        """Return a seed for this process's random numbers; the first process uses the seed of a single process."""
        return (
            seed if self.is_first else int(np.random.SeedSequence((seed, self.rank)).generate_state(1, np.uint64)[0])
        )

    def local_config(self, config: TrainConfig) -> TrainConfig:
        """Return the settings of one process, with its equal part of every batch.

        Raises:
            SsilkError: a batch does not divide.
        """
        for name in BATCH_SETTINGS:
            value = getattr(config, name)
            if value % self.size != 0:
                fail(
                    f"setting '{name}'",
                    f"{value} for {self.size} processes",
                    "each takes an equal part",
                    f"use a multiple of {self.size}",
                )
        return replace(config, **{name: getattr(config, name) // self.size for name in BATCH_SETTINGS})

    def average(self, tensors: list[Tensor]) -> None:
        """Replace tensors by their means over all processes, with one all-reduce that a CUDA graph can capture.

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
                f"process {self.rank + 1} of {self.size}: the others cannot be reached ({reason}); read "
                "their messages for the cause, then train again with --resume."
            ) from error


SINGLE_PROCESS = ProcessGroup()


@contextmanager
def join_process_group(device: str) -> Iterator[tuple[ProcessGroup, str]]:
    """Join the processes that torchrun has started; yield the group and this process's device.

    Without torchrun, the group is a single process on the requested device. Host values use gloo, so that their
    exchange does not wait for a GPU; gradients on GPUs use NCCL.

    Raises:
        SsilkError: the device has a number, or there are fewer GPUs than processes.
    """
    if any(name not in os.environ for name in TORCHRUN_VARIABLES) or os.environ["WORLD_SIZE"] == "1":
        yield SINGLE_PROCESS, device
        return
    own = _own_device(device, int(os.environ["LOCAL_RANK"]))
    dist.init_process_group("cpu:gloo,cuda:nccl" if own.type == "cuda" else "gloo")
    group = ProcessGroup(dist.get_rank(), dist.get_world_size())
    yield group, str(own)
    # Not reached after an error, when the others may never arrive. Otherwise all leave together, because torchrun
    # ends those that remain. Captured graphs must be freed before the communicator that they hold.
    group.gather(None)
    gc.collect()
    dist.destroy_process_group()


def _own_device(name: str, local_rank: int) -> torch.device:
    if ":" in name:
        fail(
            f"--device {name}", "torchrun gives each process a GPU of its own", "'auto', 'cuda' and 'cpu' are allowed"
        )
    if name == "cpu" or not torch.cuda.is_available():
        return select_device(name)
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
