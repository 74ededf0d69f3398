# SPDX-License-Identifier: Apache-2.0
"""What single steps of a model miss, as `newton_steps` measures it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class StepErrors:
    """Means over steps.

    Attributes:
        count: how many steps.
        energy: that a Newton step would win [J].
        distance: by which it would move the garment, RMS over mass and steps [m].
    """

    count: int
    energy: float
    distance: float

    def __str__(self) -> str:
        return f"steps miss {1000 * self.energy:.3g} mJ, {1000 * self.distance:.2g} mm"

    def summary(self) -> dict[str, float]:
        """Return figures by name, in SI units, to four digits."""
        return {
            "energy that steps miss [J]": float(f"{self.energy:.4g}"),
            "steps are off by [m]": float(f"{self.distance:.4g}"),
        }
