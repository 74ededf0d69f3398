# SPDX-License-Identifier: Apache-2.0
"""Triton kernels for CUDA. Each has a reference implementation in PyTorch, which runs on all other devices.

The modules with kernels import Triton, so they are imported only where `available` returns true.
"""

from __future__ import annotations

import importlib.util

import torch
from torch import Tensor


def available(device: torch.device) -> bool:
    """Return whether a device runs the kernels: CUDA with Triton installed."""
    return device.type == "cuda" and importlib.util.find_spec("triton") is not None


def supports(x: Tensor) -> bool:
    """Return whether the kernels support a tensor: float32 on such a device."""
    return x.dtype == torch.float32 and available(x.device)
