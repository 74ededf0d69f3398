# SPDX-License-Identifier: Apache-2.0
"""Points in compact blocks, whose bounding spheres are small (numpy only)."""

from __future__ import annotations

import numpy as np

from ..assets import Floats, Ints


def compact_blocks(points: Floats, size: int) -> Ints:
    """Return indices of points (P, 3) in compact blocks, int32 (ceil(P / size), size), by bisecting the widest side.

    The last block is padded with its last index.
    """
    if not len(points):
        return np.zeros((0, size), dtype=np.int32)
    blocks, parts = [], [np.arange(len(points))]
    while parts:
        part = parts.pop()
        if len(part) <= size:
            blocks.append(np.append(part, np.repeat(part[-1:], size - len(part))) if len(part) < size else part)
            continue
        widest = np.ptp(points[part], axis=0).argmax()
        part = part[np.argsort(points[part, widest], kind="stable")]
        half = -(-len(part) // size) // 2 * size  # only whole blocks to the left
        parts += [part[half:], part[:half]]
    return np.stack(blocks).astype(np.int32)
