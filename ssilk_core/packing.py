# SPDX-License-Identifier: Apache-2.0
"""Arrays in fewer bytes: exactly, in the narrowest type, or in 16 bits with a scale for each row."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

INTEGERS = (np.uint8, np.int16, np.uint16, np.int32, np.int64)
STEPS = 32767  # of a 16-bit integer to either side of zero


def narrowest(array: NDArray) -> NDArray:
    """Return integers, or double precision, in the smallest type that holds each of the values exactly."""
    if array.dtype.kind in "iu":
        limits = [np.iinfo(kind) for kind in INTEGERS]
        low, high = array.min(initial=0), array.max(initial=0)
        return array.astype(next(limit.dtype for limit in limits if limit.min <= low and high <= limit.max))
    single = array.astype(np.float32)
    return single if array.dtype == np.float64 and np.array_equal(single, array) else array


def packed(rows: NDArray) -> tuple[NDArray, NDArray]:
    """Return rows (N, ...) as 16-bit multiples of a scale for each row, and the scales (N, 1, ...).

    The error is at most half a scale, 1.5e-5 of the row's largest entry; half precision, which takes as many bytes,
    is out by up to 4.9e-4 of each entry.
    """
    largest = np.abs(rows).max(axis=tuple(range(1, rows.ndim)), keepdims=True, initial=0)
    scales = np.where(largest > 0, largest / STEPS, 1).astype(np.float32)
    return np.rint(rows / scales).astype(np.int16), scales


def unpacked(steps: NDArray, scales: NDArray) -> NDArray:
    """Invert `packed`, in single precision."""
    return (steps * scales).astype(np.float32)
