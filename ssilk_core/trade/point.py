# SPDX-License-Identifier: Apache-2.0
"""What was measured of one variant, and which variants no other beats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

SECONDS = 10  # of the shots whose bytes are compared


@dataclass(frozen=True, kw_only=True)
class TradePoint:
    """One variant of one model; SI units but for times.

    Attributes:
        model, swept, variant: the model's name, what was tried, and its name.
        shapes, joints, influences, precision, fps, refine: as in `variants.Variant`.
        milliseconds, high: of a frame of the shot on the processor, numpy runtime: median and 95 % quantile.
        torch: milliseconds of a frame of the network and decoder in PyTorch, on the device; None if not measured.
        operations: multiply-adds of a frame; memory: bytes held.
        model_bytes: of the model's file; shot_bytes: of a shot of `SECONDS`, garment and skeleton.
        total: the paper's L_tot [J]; excess: over the model as trained [J].
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
