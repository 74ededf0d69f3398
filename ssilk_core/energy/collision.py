# SPDX-License-Identifier: Apache-2.0
"""The collision penalty (paper, Section 3.5)."""

from __future__ import annotations

from torch import Tensor


def collision_energy(distance: Tensor, stiffness: float, margin: float) -> Tensor:
    """Penalty of each vertex [J], stiffness * min(distance - margin, 0)^2, shape (V, N)."""
    return stiffness * (distance - margin).clamp_max(0) ** 2
