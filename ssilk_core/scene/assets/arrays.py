# SPDX-License-Identifier: Apache-2.0
"""Types and checks of the arrays in assets."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...errors import fail

UP = np.array([0.0, 1.0, 0.0])

Floats = NDArray[np.floating]
Ints = NDArray[np.integer]


def frozen(array: object, dtype: type) -> NDArray:
    """Return a read-only, contiguous copy."""
    copy: NDArray = np.array(array, dtype=dtype, order="C")
    copy.flags.writeable = False
    return copy


def assign(instance: object, **values: object) -> None:
    """Set fields of a frozen dataclass during its construction."""
    for name, value in values.items():
        object.__setattr__(instance, name, value)


def need_finite(array: NDArray, where: str, what: str) -> None:
    """Raise `SsilkError` if a row of `array` has NaN or infinity."""
    bad = np.flatnonzero(~np.isfinite(array).all(axis=tuple(range(1, array.ndim))))
    if len(bad) != 0:
        fail(
            where,
            f"{len(bad)} of {len(array)} {what} hold NaN or infinity, first number {bad[0] if len(bad) else 0}",
            "all must be finite",
            "repair or re-export the source",
        )
