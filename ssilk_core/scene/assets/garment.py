# SPDX-License-Identifier: Apache-2.0
"""A garment, its linear blend skinning and its vertex classes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...errors import fail
from .arrays import Floats, Ints, assign, frozen, need_finite
from .mesh import Mesh
from .skin import SkinWeights
from .surface import SurfaceMaterial

PINNED, TIGHT, LOOSE = 0, 1, 2
ROUNDING = 1e-6  # of levels that were stored as float32
CLASS_NAMES = ("pinned", "tight", "loose")


def classes_at(levels: Floats, tightness: float) -> NDArray[np.int8]:
    """Return the classes at a tightness in [0, 1], shape (V,).

    Args:
        levels: the least tightness at which each vertex is tight, 0 where it is pinned, shape (V,).
    """
    tight = np.where((levels <= tightness + ROUNDING) | (tightness >= 1), TIGHT, LOOSE)
    return np.where(levels <= 0, PINNED, tight).astype(np.int8)


@dataclass(frozen=True, eq=False)
class Garment:
    """A garment mesh fitted to the character's bind pose.

    Attributes:
        mesh: the garment at rest.
        skin: weights over the character's joints for linear blend skinning, or None if not authored.
        classes: PINNED, TIGHT or LOOSE for each vertex, shape (V,), or None if not authored.
        pins: 1 for each vertex that is to be pinned when classes are found, 0 for others, shape (V,), or None.
        levels: the least tightness at which each vertex is tight, as `classes_at` takes it, shape (V,), or None.
        surface: the physics material that its stage states, or None.
        colour: (red, green, blue) of linear light to show it in, each from 0 to 1, or None if not authored.
        sewn: its points on the body that it was made for, where it lies on another [m], shape (V, 3), or None.
            Networks choose vertices to look at by them.
        graded: whether the rest shape of the energies is where it lies on each body, as a pattern is graded by
            sizes. Otherwise one garment is worn by all, and its rest shape is that on the body that it was made for.
    """

    mesh: Mesh
    skin: SkinWeights | None = None
    classes: Ints | None = None
    pins: Ints | None = None
    levels: Floats | None = None
    surface: SurfaceMaterial | None = None
    colour: tuple[float, float, float] | None = None
    sewn: Floats | None = None
    graded: bool = False

    def __post_init__(self) -> None:
        count = self.mesh.vertex_count
        if self.skin is not None and self.skin.vertex_count != count:
            fail(
                self.mesh.path,
                f"{self.skin.vertex_count} weight rows for {count} points",
                "one row for each point is needed",
            )
        for name, kind in (("pins", np.int8), ("levels", np.float64)):
            values = getattr(self, name)
            if values is not None:
                assign(self, **{name: frozen(values, kind)})
                if getattr(self, name).shape != (count,):
                    fail(self.mesh.path, f"{len(values)} {name} for {count} points", "one for each point is needed")
        if self.sewn is not None:
            assign(self, sewn=frozen(self.sewn, np.float64))
            need_finite(self.sewn, self.mesh.path, "sewn points")
            if self.sewn.shape != (count, 3):
                fail(self.mesh.path, f"sewn points of shape {self.sewn.shape}", f"({count}, 3) is needed")
        if self.classes is not None:
            classes = frozen(self.classes, np.int8)
            assign(self, classes=classes)
            if classes.shape != (count,):
                fail(
                    self.mesh.path,
                    f"{classes.size} vertex classes for {count} points",
                    "primvars:ssilk:class needs one value for each point",
                    "paint the classes again",
                )
            bad = int(np.count_nonzero((classes < PINNED) | (classes > LOOSE)))
            if bad != 0:
                fail(
                    self.mesh.path,
                    f"{bad} vertex classes are not 0, 1 or 2",
                    "pinned is 0, tight is 1, loose is 2",
                    "paint the classes again",
                )

    @property
    def sewn_mesh(self) -> Mesh:
        """The mesh as it was made: at `sewn`, where it lies on another body."""
        return self.mesh if self.sewn is None else replace(self.mesh, points=self.sewn)

    @property
    def rest_mesh(self) -> Mesh:
        """The mesh in the rest shape of the energies."""
        return self.mesh if self.graded else self.sewn_mesh
