# SPDX-License-Identifier: Apache-2.0
"""Fabrics in physical units, their presets, and those that stages state."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import NoReturn

import numpy as np

from ..errors import fail, fail_unknown
from .assets import PLATE_THICKNESS, Mesh, SurfaceMaterial

STRETCH_MODELS = ("stvk", "baraff_witkin")
CONTACT_MODELS = ("surface", "vertex")
MOST_FRICTION = 2.0  # of rubber on rubber; cloth on skin has some 0.2 to 1
PLATE_POISSON = 0.3  # of a stage that says none: the fallback of USD's proposal


@dataclass(frozen=True)
class Fabric:
    """Material of a garment (paper, Section 3.5; energies in `ssilk_core.physics.energy`).

    Attributes:
        density: mass per area [kg/m2].
        stretch_model: "stvk" (St. Venant-Kirchhoff) or "baraff_witkin".
        lame_mu, lame_lambda: Lame parameters of the membrane [N/m]; used by "stvk".
        stretch, shear: stiffness along and across the threads [N/m]; used by "baraff_witkin".
        bending: dihedral stiffness [N m] (per radian squared).
        contact_model: "surface" (`energy.collision`) or "vertex", the paper's penalty, which depends on the mesh.
        contact, loose_contact: stiffness of contact at the skin, for each area of tight and pinned cloth, and of
            loose cloth [N/m3]; used by "surface". Tight cloth is under tension, loose cloth only under its weight.
        collision: penalty stiffness for each vertex [N/m, per vertex]; used by "vertex".
        margin: gap between the fabric and the body at which contact begins [m].
        thickness: of the fabric, whose mesh lies in its middle [m].
        tether: stiffness, for each area, that holds tight cloth where linear blend skinning puts it [N/m3]. It stands
            in for friction, without which tight cloth slides to where the body is thin.
        stitch: stiffness, for each area, that holds islands of a garment where they lie on one another at rest
            [N/m3] (`energy.stitching`). By default cloth that carries a hundred times its weight stays within a
            millimetre.
        drag: air drag per area and velocity [kg/(m2 s)], relative to air that moves with the character's root.
            The default stops light cloth from swinging within about half a second. Zero is the paper's vacuum.
        friction: Coulomb's coefficient, of cloth on the body, on floors and props, and on cloth, at most
            `MOST_FRICTION`. The simulator knows it, and refinement that looks back: networks are trained without.
    """

    name: str
    density: float = 0.15
    stretch_model: str = "stvk"
    lame_mu: float = 22.2
    lame_lambda: float = 41.8
    stretch: float = 20.0
    shear: float = 2.0
    bending: float = 1e-5
    contact_model: str = "surface"
    contact: float = 1e6
    loose_contact: float = 2e5
    collision: float = 10.0
    margin: float = 8e-3
    thickness: float = 1e-3
    tether: float = 1e3
    stitch: float = 1e6
    drag: float = 0.3
    friction: float = 0.0

    def __post_init__(self) -> None:
        if self.stretch_model not in STRETCH_MODELS:
            fail(
                f"fabric '{self.name}'",
                f"stretch model '{self.stretch_model}'",
                f"it must be one of {', '.join(STRETCH_MODELS)}",
            )
        if self.contact_model not in CONTACT_MODELS:
            fail(
                f"fabric '{self.name}'",
                f"contact model '{self.contact_model}'",
                f"it must be one of {', '.join(CONTACT_MODELS)}",
            )
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, (int, float)) and not 0 <= value < float("inf"):
                fail(f"fabric '{self.name}'", f"{item.name} = {value}", "it must be finite and not negative")
        if not self.density > 0:
            fail(f"fabric '{self.name}'", "a density of zero", "it must be positive")
        if self.friction > MOST_FRICTION:
            allowed = f"Coulomb's coefficient of cloth is some 0.2 to 1, and {MOST_FRICTION:g} at most"
            fail(f"fabric '{self.name}'", f"friction = {self.friction:g}", allowed)

    @property
    def contact_distance(self) -> float:
        """Distance between body and mesh at which contact begins [m]."""
        return self.margin + 0.5 * self.thickness


# Areal densities are typical mid-weight values of each cloth. `bending` lets each drape as is published of real cloth
# (docs/training.md, "How the presets hang"). The membrane is scaled from the neutral default of NCS and keeps the
# order of real cloths. Real membranes are stiffer by orders of magnitude, which affects the conditioning more than
# the appearance.
FABRICS: dict[str, Fabric] = {
    fabric.name: fabric
    for fabric in (
        Fabric("default"),
        # The contact of the paper's tables.
        Fabric("paper", contact_model="vertex", margin=4e-3, thickness=0.0, tether=0.0, stitch=0.0),
        Fabric(
            "silk",
            density=0.08,
            lame_mu=15.0,
            lame_lambda=28.0,
            stretch=14.0,
            shear=1.2,
            bending=7e-6,
            thickness=3e-4,
        ),
        Fabric(
            "cotton",
            density=0.15,
            lame_mu=30.0,
            lame_lambda=45.0,
            stretch=27.0,
            shear=3.0,
            bending=7e-5,
            thickness=6e-4,
        ),
        Fabric(
            "denim",
            density=0.40,
            lame_mu=80.0,
            lame_lambda=100.0,
            stretch=70.0,
            shear=10.0,
            bending=4e-4,
            thickness=1.2e-3,
        ),
        Fabric(
            "wool",
            density=0.30,
            lame_mu=35.0,
            lame_lambda=50.0,
            stretch=30.0,
            shear=4.0,
            bending=9e-5,
            thickness=2e-3,
        ),
        Fabric(
            "leather",
            density=0.60,
            lame_mu=120.0,
            lame_lambda=160.0,
            stretch=110.0,
            shear=25.0,
            bending=2.8e-4,
            thickness=1.5e-3,
        ),
    )
}


def fabric_named(name: str) -> Fabric:
    """Return a preset; raise `SsilkError` for an unknown name."""
    if name not in FABRICS:
        fail_unknown(f"fabric '{name}'", "no such preset", name, FABRICS)
    return FABRICS[name]


def fabric_of_surface(surface: SurfaceMaterial) -> Fabric:
    """Return the default fabric with everything that a stage's physics material says.

    A plate of the thickness h has, in plane stress, lame_mu = E h / (2 (1 + nu)), lame_lambda = E h nu / (1 - nu^2),
    and the bending stiffness D = E h^3 / (12 (1 - nu^2)) (Timoshenko and Woinowsky-Krieger, Theory of Plates and
    Shells, 1959). Rolled up to the curvature kappa it stores D kappa^2 / 2 for each area, and the hinges of
    `energy.bending` store `bending` kappa^2 / 8: `bending` is 4 D. Stiffnesses that the stage states go before E.

    Raises:
        SsilkError: stretch or shear has no stiffness.
    """
    thickness = surface.thickness or PLATE_THICKNESS
    changes = {"thickness": surface.thickness, "density": surface.area_density}
    if surface.density is not None and surface.area_density is None:
        changes["density"] = surface.density * thickness
    stretch, shear, bend = _stiffnesses(surface)
    if stretch is not None and shear is not None:
        mu = min(shear, stretch / 2)
        if mu == 0:
            _fail_without_stiffness(surface)
        changes |= {"lame_mu": mu, "lame_lambda": stretch - 2 * mu, "stretch": stretch / 2, "shear": mu / 2}
    changes["bending"] = None if bend is None else 4 * bend
    said = {name: value for name, value in changes.items() if value is not None}
    return replace(FABRICS["default"], name=surface.path.rpartition("/")[2], **said)  # type: ignore[arg-type]


FRICTION = (
    "'ssilk simulate' and 'bake --refine N --feedback' know friction (--material friction=0.4); networks are trained "
    "without it"
)


def surface_message(surface: SurfaceMaterial, fabric: Fabric) -> str:
    """Return a sentence without its stop: what a fabric takes of a stage's physics material, and what it cannot."""
    default, units = FABRICS["default"], {"density": "kg/m2", "thickness": "m", "bending": "N m"}
    own = ("density", "thickness", "lame_mu", "lame_lambda", "bending")
    taken = [
        f"{name} {getattr(fabric, name):.4g} {units.get(name, 'N/m')}"
        for name in own
        if getattr(fabric, name) != getattr(default, name)
    ]
    values = ", ".join(taken) or "the values of the default"
    text = f"the fabric is that of the stage's physics material, with {values}"
    stiffest = max(preset.lame_mu for preset in FABRICS.values())
    if fabric.lame_mu > stiffest:
        text += f", {fabric.lame_mu / stiffest:.3g} times the lame_mu of the stiffest preset"
    stretch, shear, _ = _stiffnesses(surface)
    excess = stretch is not None and shear is not None and shear > stretch / 2 * (1 + 1e-6)
    beyond = ["shear that is stiffer than half the stretch"] if excess else []
    if lost := [*surface.others, *beyond]:
        text += f"; it leaves out {', '.join(lost)}"
    if any("friction" in name.lower() for name in surface.others):
        text += f"; {FRICTION}"
    return text


def stiffness_words(mesh: Mesh) -> str:
    """Return a sentence without its stop: how much of a garment's mesh is stiffer than its fabric, and softer."""
    assert mesh.stiffness is not None
    least, most = float(mesh.stiffness.min()), float(mesh.stiffness.max())
    count = int(np.count_nonzero(mesh.stiffness != 1))
    factors = f"{least:.3g}" if least == most else f"{least:.3g} to {most:.3g}"
    return (
        f"{count:,} of {mesh.vertex_count:,} vertices have another stiffness than the fabric's, which is multiplied "
        f"by {factors}"
    )


def _fail_without_stiffness(surface: SurfaceMaterial) -> NoReturn:
    stated = {"surfaceStretchStiffness": surface.stretch, "surfaceShearStiffness": surface.shear}
    name = next((name for name, value in stated.items() if value == 0), "youngsModulus")
    fail(surface.path, f"{name} is 0, so that lame_mu is 0", "it must be positive", "correct it, or remove it")


def _stiffnesses(surface: SurfaceMaterial) -> tuple[float | None, float | None, float | None]:
    """Return the stiffness of uniaxial strain, of simple shear [N/m], and of bending [N m].

    What is stated goes before what follows from E. Where neither is there, stretch and shear follow from each other.
    """
    stretch, shear, bend = surface.stretch, surface.shear, surface.bend
    nu = PLATE_POISSON if surface.poissons_ratio is None else surface.poissons_ratio
    if surface.youngs_modulus is not None:
        thickness = surface.thickness or PLATE_THICKNESS
        plate = surface.youngs_modulus * thickness
        stretch = plate / (1 - nu**2) if stretch is None else stretch
        shear = plate / (2 * (1 + nu)) if shear is None else shear
        bend = plate * thickness**2 / (12 * (1 - nu**2)) if bend is None else bend
    elif stretch is not None and shear is None:
        shear = stretch * (1 - nu) / 2
    elif shear is not None and stretch is None:
        stretch = 2 * shear / (1 - nu)
    return stretch, shear, bend
