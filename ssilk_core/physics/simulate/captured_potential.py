# SPDX-License-Identifier: Apache-2.0
"""What Newton's method asks of a potential, as CUDA graphs (`physics.captured`)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torch import Tensor

from ..captured import Captured
from ..collision import SmoothedDistance

if TYPE_CHECKING:
    from .incremental_potential import IncrementalPotential, StepInputs


class CapturedPotential:
    """What Newton's method asks of a potential, for inputs that are `StepInputs.is_plain`.

    Attributes:
        state: of positions and inputs, the energy, and the tensors of the distance to the body, where there is one.
        gradient: of positions, inputs and distance, as `IncrementalPotential.gradient` returns it.
        hessian: of these and the other arguments of `IncrementalPotential.hessian`, the stored blocks, and those of
            the inverse diagonal.
    """

    def __init__(self, potential: IncrementalPotential) -> None:
        def state(x: Tensor, inputs: StepInputs) -> list[Tensor]:
            distance = potential.body_distance(x, inputs)
            return [potential.energy(x, inputs, distance), *(distance.tensors() if distance else [])]

        def gradient(x: Tensor, inputs: StepInputs, distance: SmoothedDistance | None) -> list[Tensor]:
            return [potential.gradient(x, inputs, distance)]

        def hessian(x: Tensor, inputs: StepInputs, *others: Any) -> list[Tensor]:
            matrix = potential.hessian(x, inputs, *others)
            return [matrix.blocks, matrix.inverse_diagonal()]

        self.state, self.gradient, self.hessian = Captured(state), Captured(gradient), Captured(hessian)
