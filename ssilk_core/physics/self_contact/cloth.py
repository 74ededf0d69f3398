# SPDX-License-Identifier: Apache-2.0
"""The cloth that can touch: one garment, or all of an outfit as one list of vertices and triangles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...scene.assets import LOOSE, PINNED, Floats, Ints, Scene
from ...scene.fabrics import Fabric


@dataclass(frozen=True, eq=False)
class TouchingCloth:
    """Cloth of G garments, whose V vertices and F triangles follow each other.

    Attributes:
        points: in the bind pose [m], shape (V, 3).
        faces: shape (F, 3).
        garment: number of each vertex's garment, shape (V,).
        loose, pinned: bool, shape (V,).
        start: distance between two middles of the vertex's cloth at which contact begins [m], shape (V,).
        stiffness: of its contact [N/m3], shape (V,).
        ramp: depth over which the stiffness grows from zero [m], the largest of all garments.
    """

    points: Floats
    faces: Ints
    garment: Ints
    loose: np.ndarray
    pinned: np.ndarray
    start: Floats
    stiffness: Floats
    ramp: float

    @classmethod
    def of(
        cls, scene: Scene, fabric: Fabric, points: Floats | None = None, *, beside_others: bool = False
    ) -> TouchingCloth:
        """Return that of a scene's garment.

        Args:
            points: other points of the bind pose (V, 3).
            beside_others: tight and pinned cloth has the stiffness that it has on skin: its tether presses it
                harder on other cloth than its weight does.
        """
        mesh, gap = scene.garment.mesh, 0.5 * fabric.margin
        at = mesh.points if points is None else points
        start, stiffness = (np.full(len(at), value) for value in (fabric.thickness + gap, fabric.loose_contact))
        classes, one = scene.classes, np.zeros(len(at), dtype=np.int64)
        if beside_others:
            stiffness = np.where(classes == LOOSE, fabric.loose_contact, max(fabric.contact, fabric.loose_contact))
        return cls(at, mesh.faces, one, classes == LOOSE, classes == PINNED, start, stiffness, gap)

    @classmethod
    def joined(cls, parts: Sequence[TouchingCloth]) -> TouchingCloth:
        """Return the cloth of several garments, each with a number of its own."""
        counts = [len(part.points) for part in parts]
        before = np.cumsum([0, *counts[:-1]])
        rows = ("points", "loose", "pinned", "start", "stiffness")
        joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in rows}
        return cls(
            faces=np.concatenate([part.faces + first for part, first in zip(parts, before)]),
            garment=np.repeat(np.arange(len(parts)), counts),
            ramp=max(part.ramp for part in parts),
            **joined,
        )
