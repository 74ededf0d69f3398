# SPDX-License-Identifier: Apache-2.0
"""Blendshapes of a character's meshes that a shot weighs otherwise than the character's stage does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...errors import fail
from .arrays import Floats, Ints, assign, frozen, need_finite

OFF = "_off"  # ends the name of a shape that a shot weighs less than its character's stage does


@dataclass(frozen=True, eq=False)
class BodyShape:
    """A blendshape of one of a character's meshes, from the shape that its stage gives the mesh; or an in-between.

    `Motion.shape_weights` say how much of it is on in each frame, from none (0) to the most in the shot (1).

    Attributes:
        name: of the blendshape, and of the in-between; ends in `OFF` where the shot takes it off.
        body: which mesh, as an index into bodies followed by stand-ins.
        rows: indices of the points that it moves, shape (R,).
        offsets: of these in the bind pose [m], where it is on the most, shape (R, 3).
    """

    name: str
    body: int
    rows: Ints
    offsets: Floats

    def __post_init__(self) -> None:
        rows, offsets = frozen(self.rows, np.int32), frozen(self.offsets, np.float64)
        if offsets.shape != (len(rows), 3):
            fail(self.name, f"offsets of shape {offsets.shape}", f"({len(rows)}, 3) is needed")
        need_finite(offsets, self.name, "offsets")
        assign(self, rows=rows, offsets=offsets)


def shaped(points: Floats, shapes: Sequence[BodyShape], weights: Floats, body: int) -> Floats:
    """Return the points of a mesh in the bind pose [m], shape (V, 3), with its shapes on, shape (F, V, 3).

    Args:
        shapes: of any meshes, of which those of `body` count.
        weights: of all of them in each frame, shape (F, K).
    """
    found = np.repeat(points[None], len(weights), axis=0)
    for shape, course in zip(shapes, weights.T):
        if shape.body == body:
            found[:, shape.rows] += course[:, None, None] * shape.offsets
    return found
