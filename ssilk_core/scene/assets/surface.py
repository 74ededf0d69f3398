# SPDX-License-Identifier: Apache-2.0
"""The physics material that a stage states for a garment."""

from __future__ import annotations

from dataclasses import dataclass, fields
from math import inf

from ...errors import fail

PLATE_THICKNESS = 1e-3  # [m] of cloth whose stage says none: the fallback of USD's proposal
_POSITIVE = ("thickness", "density", "area_density")


@dataclass(frozen=True, kw_only=True)
class SurfaceMaterial:
    """What a stage says of the material of a surface deformable; None for what it does not say.

    Attributes:
        path: file and prim that say it.
        thickness: of the cloth [m].
        density: mass per volume [kg/m3].
        area_density: mass per area [kg/m2], where the stage states the mass of the garment.
        youngs_modulus: E [Pa].
        poissons_ratio: nu, above -1 and at most 0.5.
        stretch: stiffness of uniaxial strain [N/m], E h / (1 - nu^2) in a plate of the thickness h.
        shear: stiffness of simple shear [N/m], E h / (2 (1 + nu)) in a plate.
        bend: bending stiffness [N m], E h^3 / (12 (1 - nu^2)) in a plate.
        others: names of what is said beside these, such as friction.
    """

    path: str
    thickness: float | None = None
    density: float | None = None
    area_density: float | None = None
    youngs_modulus: float | None = None
    poissons_ratio: float | None = None
    stretch: float | None = None
    shear: float | None = None
    bend: float | None = None
    others: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not isinstance(value, float):
                continue
            fits, allowed = 0 <= value < inf, "it must be finite and not negative"
            if item.name == "poissons_ratio":
                fits, allowed = -1 < value <= 0.5, "it must be above -1 and at most 0.5"
            elif item.name in _POSITIVE:
                fits, allowed = 0 < value < inf, "it must be finite and positive"
            if not fits:
                fail(self.path, f"the {item.name} of its physics material is {value:g}", allowed, "correct it")
