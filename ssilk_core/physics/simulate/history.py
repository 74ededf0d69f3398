# SPDX-License-Identifier: Apache-2.0
"""What a step needs of the steps before it."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from ..collision.pierced import PiercedCloth, PiercedOutfit
from ..framed import Framed
from ..self_contact import ClothNeighbours
from .characters import PosedCharacters
from .friction import Friction


@dataclass(frozen=True, eq=False)
class StepHistory(Framed):
    """The previous states of N shots.

    Attributes:
        last, before: positions one and two steps ago in world space [m], float64, shape (V, 3, N); `before` is None
            in the second step. After shorter steps it is where the last velocity leads back to in a whole one.
        root: the character's root one step ago [m], float64, shape (3, N).
        lbs: the garment under linear blend skinning one step ago, relative to that root, shape (V, 3, N).
        neighbours: which cloth may touch which, where that is looked at.
        friction: of what presses at the last positions, for the next step; None without.
        matrices: skinning matrices one step ago (`PosedCharacters.matrices`), between which and the next ones the
            body is posed in shorter steps; None where no step is to be split. `moves` likewise
            (`PosedCharacters.moves`).
        pierced: the cloth that limbs were through at the last positions, which a shorter step holds on to.
    """

    last: Tensor
    before: Tensor | None
    root: Tensor
    lbs: Tensor
    neighbours: ClothNeighbours | None = None
    friction: Friction | None = None
    matrices: Tensor | None = None
    pierced: PiercedCloth | PiercedOutfit | None = None
    moves: Tensor | None = None

    @property
    def local(self) -> Tensor:
        """The last positions relative to the root at that time, shape (V, 3, N)."""
        return (self.last - self.root).to(self.lbs.dtype)

    def follow_lbs(self, poses: PosedCharacters) -> Tensor:
        """Return the last positions moved along with linear blend skinning, relative to the roots of `poses`."""
        return self.local - self.lbs + poses.lbs
