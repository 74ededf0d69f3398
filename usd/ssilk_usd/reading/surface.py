# SPDX-License-Identifier: Apache-2.0
"""Read the physics material of a garment as a surface deformable. Attributes are read by name, without a plug-in.

The names are those of the proposal "Deformable Body Physics in USD" (OpenUSD-proposals, pull request 111), which
newton reads too, and of an earlier revision of it in NVIDIA's Omni Physics Deformable Schema. The proposal states
stiffnesses of the cloth. Its earlier revisions state moduli: stretch and shear times h, bending times h^3 are
stiffnesses (newton, `import_usd_deformable_cloth.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, nan

import numpy as np
from pxr import Usd, UsdGeom, UsdPhysics, UsdShade

from ssilk_core.errors import fail
from ssilk_core.events import Message, Reporter
from ssilk_core.scene.assets import PLATE_THICKNESS, Floats, Mesh, SurfaceMaterial

from ..opening.stage import has_value, location, value
from ..units import StageUnits

PHYSICS = "physics"  # a purpose of bindings
PROPOSAL, OMNI = "physics:", "omniphysics:"
_STIFFNESSES = {  # name, that of older revisions, and the power of the thickness that makes a modulus a stiffness
    "stretch": ("surfaceStretchStiffness", "stretchStiffness", 1),
    "shear": ("surfaceShearStiffness", "shearStiffness", 1),
    "bend": ("surfaceBendStiffness", "bendStiffness", 3),
}
_THICKNESS = ("surfaceThickness", "thickness")
_OF_SURFACES = (
    "youngsModulus",
    "poissonsRatio",
    "thicknesses",
    *_THICKNESS,
    *(name for current, older, _ in _STIFFNESSES.values() for name in (current, older)),
)
_OF_VOLUMES = ("youngsModulus", "poissonsRatio", "density")  # too, where their schema is applied
_REST = ("restShapePoints", "restTriVertexIndices", "restBendAngles", "restBendAnglesDefault")
_MORE = (PROPOSAL, OMNI, "physxDeformableMaterial:")  # where materials say what is not read
_OMNI_POISSON = 0.45  # the fallback of its schema
_CORRECT = "correct it, or remove the attribute"


def read_surface(prim: Usd.Prim, mesh: Mesh) -> SurfaceMaterial | None:
    """Read the physics material of a garment's mesh; None where nothing says what a surface is made of.

    The material that UsdShade finds bound for the purpose "physics", else for all, goes before the mesh. As in the
    proposal, the mass of the mesh and of its deformable body go before densities, and the body's density before the
    material's. Moduli and density of a material of volumes are none of a surface, unless it is of surfaces as well.

    Args:
        prim: the mesh.
        mesh: the same in the core's units, whose area a mass is spread over.

    Raises:
        SsilkError: a value is not what its attribute allows.
    """
    bound = bound_material(prim)
    said = [source for source in (bound, prim) if source]
    if not any(_is_of_surfaces(source) for source in said):
        return None
    meters = StageUnits.of(prim.GetStage()).meters_per_unit
    kilograms = UsdPhysics.GetStageKilogramsPerUnit(prim.GetStage())
    thicknesses, body = _array(prim, "thicknesses"), [found for found in [deformable_body(prim)] if found]
    thickness = float(thicknesses.mean()) if len(thicknesses) else _number(said, *_THICKNESS)
    thickness = thickness * meters if thickness is not None else None
    young, poisson = _number(said, "youngsModulus"), _number(said, "poissonsRatio")
    if poisson is None and young is not None and any(_says(source, f"{OMNI}youngsModulus") for source in said):
        poisson = _OMNI_POISSON
    density = _number(body, "density") or _number(said, "density")  # zero is ignored, as in the proposal
    mass, area = float(_array(prim, "masses").sum()) or _number(body, "mass"), _area(mesh)
    stiffnesses = [
        _stiffness(said, mode, kilograms, meters, PLATE_THICKNESS if thickness is None else thickness)
        for mode in _STIFFNESSES
    ]
    return SurfaceMaterial(
        path=location(said[0]),
        thickness=thickness,
        density=density * kilograms / meters**3 if density else None,
        area_density=mass * kilograms / area if mass and area else None,
        youngs_modulus=young * kilograms / meters if young is not None else None,
        poissons_ratio=poisson,
        stretch=stiffnesses[0],
        shear=stiffnesses[1],
        bend=stiffnesses[2],
        others=(*_others(bound, prim), *(["thickness that varies"] if len(set(thicknesses)) > 1 else [])),
    )


def bound_material(prim: Usd.Prim) -> Usd.Prim | None:
    """Return the material that is bound to a mesh for physics, else for all: by itself, above, or by collection."""
    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial(PHYSICS)
    return material.GetPrim() if material else None


def tell_parts(prim: Usd.Prim, report: Reporter) -> None:
    """Report fabrics that are bound to subsets of a mesh: a garment has one."""
    whole, parts = bound_material(prim), []
    for subset in UsdGeom.Subset.GetAllGeomSubsets(UsdGeom.Imageable(prim)):
        found = bound_material(subset.GetPrim())
        if found and found != whole and _is_of_surfaces(found):
            parts.append(f"{found.GetName()} of {subset.GetPrim().GetName()}")
    if parts:
        text = f"{location(prim)}: fabrics of parts of it are left out: {', '.join(parts)}"
        report(Message(f"{text}; a garment has one fabric throughout, that of the mesh", "warning"))


def deformable_body(prim: Usd.Prim) -> Usd.Prim | None:
    """Return the deformable body that a mesh belongs to: itself, the nearest one above it, or None."""
    while prim and not prim.IsPseudoRoot():
        if any(name.endswith("DeformableBodyAPI") for name in _applied(prim)):
            return prim
        prim = prim.GetParent()
    return None


def _applied(prim: Usd.Prim) -> list[str]:
    """Return the names of the schemas that a prim applies, whether or not USD knows them."""
    schemas = prim.GetMetadata("apiSchemas")
    return list(schemas.GetAppliedItems()) if schemas else []


def _is_of_surfaces(prim: Usd.Prim) -> bool:
    """Return whether a prim says something that only surfaces have, or applies their schema."""
    names = (space + name for name in _OF_SURFACES for space in (PROPOSAL, OMNI))
    return any("SurfaceDeformable" in name for name in _applied(prim)) or any(_says(prim, name) for name in names)


def _says(prim: Usd.Prim, name: str) -> bool:
    """Return whether a prim says something of a surface, and not of a volume alone."""
    applied = _applied(prim) if name.partition(":")[2] in _OF_VOLUMES else []
    of_volume = any("VolumeDeformable" in schema for schema in applied)
    return has_value(prim, name) and (not of_volume or any("SurfaceDeformable" in schema for schema in applied))


def _number(sources: Sequence[Usd.Prim], *names: str) -> float | None:
    """Return the first number that prims say, in either schema; None for minus infinity, the proposal's fallback."""
    for source in sources:
        for name in (space + name for name in names for space in (PROPOSAL, OMNI)):
            found = value(source, name) if _says(source, name) else None
            if found is not None and found != -inf:
                return _checked(f"{location(source)}.{name}", found)
    return None


def _checked(where: str, found: object) -> float:
    """Return what an attribute says as a number; raise `SsilkError` where no cloth has it."""
    name, number = where.rpartition(":")[2], float(found) if isinstance(found, int | float) else nan
    fits, allowed = 0 <= number < inf, "a finite number that is not negative"
    if name == "poissonsRatio":
        fits, allowed = -1 < number <= 0.5, "a number above -1 and at most 0.5"
    elif name in _THICKNESS:
        fits, allowed = 0 < number < inf, "a finite, positive number"
    if not fits:
        told = f"{number:.7g}" if isinstance(found, int | float) else f"{found!r:.40}"
        fail(where, f"it is {told}", f"{allowed} is needed", _CORRECT)
    return number


def _stiffness(
    sources: Sequence[Usd.Prim], mode: str, kilograms: float, meters: float, thickness: float
) -> float | None:
    """Return a stiffness of the cloth, stated or by a modulus: [N/m], or [N m] of bending."""
    name, older, power = _STIFFNESSES[mode]
    for source in sources:
        stated = _number([source], name)
        if stated is not None and has_value(source, PROPOSAL + name):
            return stated * kilograms * (meters**2 if mode == "bend" else 1.0)
        modulus = stated or _number([source], older)  # zero leaves it to E in the Omni Physics schema
        if modulus:
            return modulus * kilograms / meters * thickness**power
    return None


def _array(prim: Usd.Prim, name: str) -> Floats:
    """Return what a mesh says of its whole, its faces or its points; nothing where it does not."""
    found = np.array(value(prim, PROPOSAL + name) if has_value(prim, PROPOSAL + name) else [])
    is_numeric = found.dtype.kind in "iuf"
    numbers = found.reshape(-1).astype(np.float64) if is_numeric else np.full(1, np.nan)
    wrong = np.flatnonzero(~(np.isfinite(numbers) & (numbers > 0)))
    if len(wrong):
        number = f"number {wrong[0]} of {len(numbers)} is {numbers[wrong[0]]:.7g}, counted from 0"
        told = number if is_numeric else f"it is {found.tolist()!r:.40}"
        fail(f"{location(prim)}.{PROPOSAL}{name}", told, "finite, positive numbers are needed", _CORRECT)
    return numbers


def _area(mesh: Mesh) -> float:
    a, b, c = (mesh.points[mesh.faces[:, corner]] for corner in range(3))
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def _others(bound: Usd.Prim | None, prim: Usd.Prim) -> list[str]:
    """Return what material and mesh say beside what is read."""
    names = [attribute.GetName() for attribute in bound.GetAuthoredAttributes()] if bound else []
    read = {space + name for name in (*_OF_SURFACES, "density") for space in (PROPOSAL, OMNI)}
    of_bound = [
        name
        for name in names
        if name.startswith(_MORE) and has_value(bound, name) and not (name in read and _says(bound, name))
    ]
    return of_bound + [PROPOSAL + name for name in _REST if has_value(prim, PROPOSAL + name)]
