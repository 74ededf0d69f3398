# SPDX-License-Identifier: Apache-2.0
"""A garment, its linear blend skinning and its vertex classes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..errors import fail
from .arrays import Ints, assign, frozen
from .mesh import Mesh
from .skin import SkinWeights

PINNED, TIGHT, LOOSE = 0, 1, 2
CLASS_NAMES = ("pinned", "tight", "loose")


@dataclass(frozen=True, eq=False)
class Garment:
    """A garment mesh fitted to the character's bind pose.

    Attributes:
        mesh: the garment at rest, which is also the rest shape of the energies.
        skin: weights over the character's joints for linear blend skinning, or None if not authored.
        classes: PINNED, TIGHT or LOOSE for each vertex, shape (V,), or None if not authored.
    """

    mesh: Mesh
    skin: SkinWeights | None = None
    classes: Ints | None = None

    def __post_init__(self) -> None:
        count = self.mesh.vertex_count
        if self.skin is not None and self.skin.vertex_count != count:
            fail(
                self.mesh.path,
                f"{self.skin.vertex_count} weight rows for {count} points",
                "one row for each point is needed",
            )
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
