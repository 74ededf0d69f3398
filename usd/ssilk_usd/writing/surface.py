# SPDX-License-Identifier: Apache-2.0
"""Write the physics material of a garment as `reading.surface` reads it."""

from __future__ import annotations

from dataclasses import astuple, replace
from math import isclose

from pxr import Sdf, Usd, UsdPhysics, UsdShade, Vt

from ssilk_core.scene.assets import PLATE_THICKNESS, Mesh, SurfaceMaterial

from ..reading.surface import PROPOSAL, deformable_body, read_surface
from ..units import StageUnits

MATERIAL_API, SIM_API = "PhysicsSurfaceDeformableMaterialAPI", "PhysicsSurfaceDeformableSimAPI"
BODY_API = "PhysicsDeformableBodyAPI"
_TYPES = Sdf.ValueTypeNames


def reads_as(prim: Usd.Prim, mesh: Mesh, surface: SurfaceMaterial | None) -> bool:
    """Return whether a mesh where it stands reads as a surface material, up to rounding and the material's path."""
    found = read_surface(prim, mesh)
    if found is None or surface is None:
        return found is surface
    pairs = zip(astuple(replace(found, path="")), astuple(replace(surface, path="")))
    return all(
        isclose(a, b, rel_tol=1e-6) if isinstance(a, float) and isinstance(b, float) else a == b for a, b in pairs
    )


def shield_surface(prim: Usd.Prim, path: Sdf.Path) -> None:
    """Bind a garment's mesh to a physics material at a path that says nothing, in place of what it would inherit.

    USD passes over a binding without a target and goes on to those above.
    """
    _bind(prim, UsdShade.Material.Define(prim.GetStage(), path))


def write_surface(prim: Usd.Prim, path: Sdf.Path, surface: SurfaceMaterial) -> None:
    """Define a physics material at a path and bind it to a garment's mesh, whose thickness is the mesh's own.

    A mass for each area becomes a density. The mesh becomes a deformable body where it stands in one that is not its
    own, whose mass would go before.
    """
    stage, thickness = prim.GetStage(), surface.thickness
    meters = StageUnits.of(stage).meters_per_unit
    kilograms = UsdPhysics.GetStageKilogramsPerUnit(stage)
    if surface.area_density is not None:
        surface = replace(surface, density=surface.area_density / (thickness or PLATE_THICKNESS))
    material = UsdShade.Material.Define(stage, path).GetPrim()
    material.AddAppliedSchema(MATERIAL_API)
    for name, number, unit in (
        ("density", surface.density, kilograms / meters**3),
        ("youngsModulus", surface.youngs_modulus, kilograms / meters),
        ("poissonsRatio", surface.poissons_ratio, 1.0),
        ("surfaceStretchStiffness", surface.stretch, kilograms),
        ("surfaceShearStiffness", surface.shear, kilograms),
        ("surfaceBendStiffness", surface.bend, kilograms * meters**2),
    ):
        if number is not None:
            material.CreateAttribute(PROPOSAL + name, _TYPES.Float).Set(number / unit)
    if thickness is not None:
        prim.AddAppliedSchema(SIM_API)
        prim.CreateAttribute(f"{PROPOSAL}thicknesses", _TYPES.FloatArray).Set(Vt.FloatArray([thickness / meters]))
        kind = f"{PROPOSAL}thicknesses:elementType"
        prim.CreateAttribute(kind, _TYPES.Token, variability=Sdf.VariabilityUniform).Set("constant")
    if deformable_body(prim) not in (None, prim):
        prim.AddAppliedSchema(BODY_API)
    _bind(prim, UsdShade.Material(material))


def _bind(prim: Usd.Prim, material: UsdShade.Material) -> None:
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(material, UsdShade.Tokens.fallbackStrength, "physics")
