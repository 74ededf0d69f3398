# SPDX-License-Identifier: GPL-3.0-or-later
"""The part of ssilk that plays garments with numpy alone, which the extension carries along."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from types import ModuleType

CARRIED = find_spec(".vendor", __package__)  # put there when the extension is packed; not in the project's folder


def core(name: str) -> ModuleType:
    """Return a module of `ssilk_core`: the extension's own copy, or the project's where that is on the path."""
    if CARRIED:
        return import_module(f".vendor.ssilk_core.{name}", __package__)
    return import_module(f"ssilk_core.{name}")
