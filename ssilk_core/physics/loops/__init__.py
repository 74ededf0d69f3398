# SPDX-License-Identifier: Apache-2.0
"""Loops that numba compiles for a processor: what the Triton kernels in `physics.kernels` are for a GPU.

Each has the interface of its kernel and the same reference in PyTorch, which runs where numba is not installed. The
modules with loops import numba, so they are imported only where `available` or `installed` returns true. Compiled
code is kept in numba's cache, which knows a loop by its own file: what a loop calls, and constants, are defined
beside it.
"""

from __future__ import annotations

import importlib.util
import warnings
from functools import cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch
    from torch import Tensor


def available(device: torch.device) -> bool:
    """Return whether a device runs the loops: a processor with numba installed; not while a graph is exported."""
    import torch

    return device.type == "cpu" and installed() and not torch.compiler.is_compiling()


def supports(x: Tensor) -> bool:
    """Return whether the loops support a tensor: float32 on such a device."""
    import torch

    return x.dtype == torch.float32 and available(x.device)


@cache
def installed() -> bool:
    """Return whether numba is installed and can be imported, which this does."""
    if importlib.util.find_spec("numba") is None:
        return False
    try:
        from . import compiling  # noqa: F401
    except ImportError as error:  # with another numpy, say
        warnings.warn(f"numba cannot be used, and what it compiles takes five times as long: {error}", stacklevel=3)
        return False
    return True
