# SPDX-License-Identifier: Apache-2.0
"""The size of a model."""

from __future__ import annotations

from dataclasses import dataclass

from ...errors import fail


@dataclass(frozen=True, kw_only=True)
class ModelSize:
    """The size of a model.

    Attributes:
        shapes: blendshapes; joints: proxy joints; influences: joints that move one vertex.
    """

    shapes: int
    joints: int
    influences: int

    def __post_init__(self) -> None:
        for name, least in (("shapes", 0), ("joints", 0), ("influences", 1)):
            value = getattr(self, name)
            if not value >= least:
                fail(f"{name} = {value}", "too few to be kept", f"it is at least {least}")

    @classmethod
    def of(cls, text: str) -> ModelSize:
        """Parse the result of `str`."""
        shapes, joints, influences = map(int, text.split(","))
        return cls(shapes=shapes, joints=joints, influences=influences)

    def __str__(self) -> str:
        return f"{self.shapes},{self.joints},{self.influences}"

    def within(self, other: ModelSize) -> ModelSize:
        """Return the smaller of both in each respect."""
        return ModelSize(**{name: min(most, vars(other)[name]) for name, most in vars(self).items()})
