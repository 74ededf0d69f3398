# SPDX-License-Identifier: Apache-2.0
"""What Newton's method asks of a potential, as CUDA graphs (`physics.captured`)."""

from __future__ import annotations

from dataclasses import dataclass

from ..captured import Captured


@dataclass(frozen=True, eq=False)
class CapturedPotential:
    """Functions of positions and inputs, for inputs that are `StepInputs.is_plain`.

    Attributes:
        state: returns the energy, and the tensors of the distance to the body, where there is one.
        gradient: also of that distance; returns what `IncrementalPotential.gradient` does.
        hessian: also of what touching adds to blocks on the diagonal, or None, and the other arguments of
            `IncrementalPotential.hessian`; returns the stored blocks, and the inverses of those on the diagonal.
    """

    state: Captured
    gradient: Captured
    hessian: Captured
