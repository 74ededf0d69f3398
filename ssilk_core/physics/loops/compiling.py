# SPDX-License-Identifier: Apache-2.0
"""How loops are compiled; without PyTorch, for those who play with numpy alone, too."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba

# Sums keep their order, and values that are not finite stay so. Compiled code that is kept does not know of these.
OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract", "nsz"}}


def compiled(loop: Callable[..., Any]) -> Callable[..., Any]:
    """Return a loop that numba compiles when it is called; it is kept where numba has a folder to write to."""
    try:
        kept: Callable[..., Any] = numba.njit(cache=True, **OPTIONS)(loop)
    except RuntimeError:  # no folder that this user may write to
        kept = numba.njit(**OPTIONS)(loop)
    return kept
