# SPDX-License-Identifier: Apache-2.0
"""Measurements of one variant, and the Pareto front of variants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from math import nan
from typing import Any

from ...physics.intersections.figures import SelfIntersections
from ...physics.skin.figures import ShownSkin
from ...scene.plain import from_plain

SECONDS = 10  # duration of the shots whose sizes are compared [s]


@dataclass(frozen=True, kw_only=True)
class TradePoint:
    """One variant of one model, in SI units except for times.

    Attributes:
        garment, model, swept, variant: names of the garment, of its model, of the sweep, and of the variant.
        shapes, joints, influences, precision, fps, refine: as in `variants.Variant`.
        milliseconds, high: median and 95 % quantile of the time to play a frame in the numpy runtime on the CPU [ms].
            Shots of a solver are played as the joints and blendshapes that a bake stores.
        solving: time of the solver for a frame [ms], which a bake takes once; None without it.
        torch: time per frame of network and decoder in PyTorch on the device [ms]; None if not measured.
        operations: multiply-adds per frame.
        memory: memory used by playback [bytes].
        model_bytes: size of the model's file [bytes].
        shot_bytes: size of a shot of `SECONDS` with garment and skeleton [bytes].
        total: the paper's L_tot [J].
        excess: difference of `total` from the model as trained [J].
        collisions: share of the vertices inside the body.
        shown_skin: share of the covered skin that shows; None where the garment covers nothing.
        intersections: share of the triangles that intersect others of the garment.
        position, velocity: RMS errors against the full model [m], [m/s].
    """

    garment: str
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
    shown_skin: ShownSkin | None
    intersections: SelfIntersections
    solving: float | None

    @classmethod
    def of(cls, document: Mapping[str, Any]) -> TradePoint:
        """Return a point from its JSON document, whatever else that holds.

        Raises:
            KeyError, TypeError: a value is missing, or of another type.
        """
        return from_plain(cls, {item.name: document[item.name] for item in fields(cls)}, figures=True)

    @property
    def making(self) -> float:
        """Time to make a frame [ms]: that of playing it, and of the solver on the device."""
        return self.milliseconds + (self.solving or 0.0)

    @property
    def mean_intersections(self) -> float:
        """Mean share of the triangles that intersect others of the garment."""
        return self.intersections.mean

    @property
    def mean_shown_skin(self) -> float:
        """Mean share of the covered skin that shows; NaN where there is none."""
        return self.shown_skin.mean if self.shown_skin else nan


def front(places: Sequence[tuple[float, float]]) -> list[int]:
    """Return the indices of the (cost, error) pairs on the Pareto front, the cheapest first."""
    best: list[int] = []
    for index in sorted(range(len(places)), key=places.__getitem__):
        if not best or places[index][1] < places[best[-1]][1]:
            best.append(index)
    return best
