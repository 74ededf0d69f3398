# SPDX-License-Identifier: Apache-2.0
"""Triton kernels for CUDA. Each has a reference implementation in PyTorch beside its caller, used everywhere else.

Modules with kernels import Triton, and are themselves imported only where `available` said yes.
"""

from __future__ import annotations

import importlib.util

import torch
from torch import Tensor


def available(device: torch.device) -> bool:
    """Return whether the kernels serve a device: CUDA with Triton installed. The one place that chooses."""
    return device.type == "cuda" and importlib.util.find_spec("triton") is not None


def serve(x: Tensor) -> bool:
    """Return whether the kernels serve a tensor: single precision on such a device."""
    return x.dtype == torch.float32 and available(x.device)
