# SPDX-License-Identifier: Apache-2.0
"""Velocities of a point cache, for motion blur: USD places points between samples at `points + velocities * t`.

A velocity is half the way from the sample before to the one after, so that it serves shutters on either side of the
frame. At the ends, and on both sides of a cut, it is the whole way to the one neighbour.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator
from itertools import chain, pairwise

import numpy as np

from ssilk_core.scene.assets import Floats, Motion, Skeleton
from ssilk_core.scene.kinematics import split_at_cuts


def cut_frames(motion: Motion, skeleton: Skeleton) -> frozenset[int]:
    """Return the frames that follow on a jump of the character."""
    counts = [span.frame_count for span in split_at_cuts(motion, skeleton)]
    return frozenset(np.cumsum(counts)[:-1].tolist())


def with_velocities(
    points: Iterable[Floats], rate: float, cuts: Container[int] = ()
) -> Iterator[tuple[Floats, Floats]]:
    """Yield the points (V, 3) of each sample with their velocities per second, of the same shape.

    Args:
        points: of each sample, `rate` of them in a second.
        cuts: samples that no way leads to from the one before.
    """
    before: Floats | None = None
    for number, (now, after) in enumerate(pairwise(chain(points, [None]))):
        assert now is not None  # only what follows the last sample is
        last = now if after is None or number + 1 in cuts else after
        first = now if before is None or number in cuts else before
        steps = (first is not now) + (last is not now)
        yield now, (last - first) * (rate / max(steps, 1))
        before = now
