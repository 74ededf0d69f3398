# SPDX-License-Identifier: Apache-2.0
"""Vectors in kernels over positions (vertices, 3, frames): a program holds one component of a block of frames."""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def load3(base, width, n, inside):
    """The three coordinates of frames n, `width` apart."""
    x = tl.load(base + n, mask=inside, other=0.0)
    y = tl.load(base + width + n, mask=inside, other=0.0)
    z = tl.load(base + 2 * width + n, mask=inside, other=0.0)
    return x, y, z


@triton.jit
def store3(base, width, n, inside, x, y, z):
    tl.store(base + n, x, mask=inside)
    tl.store(base + width + n, y, mask=inside)
    tl.store(base + 2 * width + n, z, mask=inside)


@triton.jit
def dot(ax, ay, az, bx, by, bz):
    return ax * bx + ay * by + az * bz


@triton.jit
def cross(ax, ay, az, bx, by, bz):
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
