# SPDX-License-Identifier: Apache-2.0
"""The measurements of one variant, and the front of variants that no other beats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

SECONDS = 10  # length of the shots whose sizes are compared


@dataclass(frozen=True, kw_only=True)
class TradePoint:
    """One variant of one model, in SI units except for times.

    Attributes:
        model, swept, variant: names of the model, of the sweep, and of the variant.
        shapes, joints, influences, precision, fps, refine: as in `variants.Variant`.
        milliseconds, high: median and 95 % quantile of a frame's time in the numpy runtime, on the processor.
        torch: time of a frame of network and decoder in PyTorch, on the device [ms]; None if not measured.
        operations: multiply-adds of a frame.
        memory: bytes that playing holds.
        model_bytes: size of the model's file.
        shot_bytes: size of a shot of `SECONDS`, garment and skeleton.
        total: the paper's L_tot [J].
        excess: over the model as trained [J].
        collisions: share of the vertices inside the body.
        position, velocity: RMS errors against the whole model [m], [m/s].
    """

    model: str
    swept: str
    variant: str
    shapes: int
    joints: int
    influences: int
    precision: str
    fps: float
    refine: int
    milliseconds: float
    high: float
    torch: float | None
    operations: int
    memory: int
    model_bytes: int
    shot_bytes: float
    total: float
    excess: float
    collisions: float
    position: float
    velocity: float


def front(places: Sequence[tuple[float, float]]) -> list[int]:
    """Return which of some (cost, error) no other equals at less cost or beats at equal cost, the cheapest first."""
    best: list[int] = []
    for index in sorted(range(len(places)), key=places.__getitem__):
        if not best or places[index][1] < places[best[-1]][1]:
            best.append(index)
    return best
