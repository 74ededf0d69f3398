# SPDX-License-Identifier: Apache-2.0
"""Frames of other fabrics than a garment's own in one batch: factors of its properties in each frame."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ...scene.fabric_range import UNIT
from ...scene.fabrics import Fabric


@dataclass(frozen=True, eq=False)
class FabricFactors:
    """Factors of the fabric in N frames, as `scene.fabric_range` has them, each (N,)."""

    stretch: Tensor
    shear: Tensor
    bending: Tensor
    density: Tensor
    drag: Tensor

    @classmethod
    def of(cls, inputs: Tensor) -> FabricFactors:
        """Return those that inputs (N, 5) of a network stand for."""
        return cls(*(UNIT * inputs).exp().unbind(1))

    def moduli(self, fabric: Fabric) -> tuple[Tensor, Tensor]:
        """Return both moduli of a fabric's stretch model in each frame [N/m], (N,), in the order of `stretch`."""
        shear = self.stretch * self.shear
        if fabric.stretch_model == "stvk":
            return fabric.lame_mu * shear, fabric.lame_lambda * self.stretch
        return fabric.stretch * self.stretch, fabric.shear * shear

    def first(self, count: int) -> FabricFactors:
        """Return those of the first frames."""
        return FabricFactors(*(each[:count] for each in vars(self).values()))


def joined_inputs(*parts: Tensor | None) -> Tensor | None:
    """Return inputs (N, 5) of consecutive frames together; None where they are of the garment's own fabric."""
    given = [part for part in parts if part is not None]
    return torch.cat(given) if given else None
