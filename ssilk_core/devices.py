# SPDX-License-Identifier: Apache-2.0
"""Devices by name."""

from __future__ import annotations

import os
import platform
import sys
from typing import TYPE_CHECKING

from .errors import fail

if TYPE_CHECKING:
    import torch


def select_device(name: str) -> torch.device:
    """Return the device for "auto" or a torch device name.

    Raises:
        SsilkError: the device does not exist here.
    """
    import torch

    if name == "auto":
        return torch.device(usual_device())
    try:
        device = torch.device(name)
        torch.empty(1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).partition("\n")[0].rstrip(".")
        fail(f"--device {name}", f"no such device here ({reason})", "'auto', 'cpu' and 'cuda' are common")
    return device


def usual_device() -> str:
    """Return what "auto" stands for, "cuda" or "cpu"; to say so, a torch of processors alone need not be loaded."""
    if "torch" not in sys.modules and _for_processors():
        return "cpu"
    import torch

    return "cuda" if torch.cuda.is_available() else "cpu"


def _for_processors() -> bool:
    """Return whether the torch that is installed says of itself that it was built for processors alone."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("torch").endswith("+cpu")
    except PackageNotFoundError:  # it lies on the path without being installed
        return False


def default_preset(name: str) -> str:
    """Return the preset that a device finishes while someone waits: "draft" on a processor, else "preview".

    Args:
        name: as for `select_device`.
    """
    device = usual_device() if name == "auto" else select_device(name).type
    return "draft" if device == "cpu" else "preview"


BUSY = 0.75  # cores that other programs take, from which on it is told


def busy_cores() -> float:
    """Return how many cores programs kept busy, or would have, in the last minute; 0 where no system tells."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0


def kept_busy(busy: float) -> str:
    """Return in words that other programs keep cores busy, or wait for them; "" where few do."""
    return f"other programs put a load of about {busy:.1f} on {os.cpu_count()} cores" if busy >= BUSY else ""


def device_name(device: torch.device) -> str:
    """Return the name of the hardware."""
    import torch

    return torch.cuda.get_device_name(device) if device.type == "cuda" else f"{device.type} ({platform.machine()})"
