# SPDX-License-Identifier: Apache-2.0
"""Write the physics material of a garment as `read_surface` reads it."""

from __future__ import annotations

from dataclasses import replace

from pxr import Sdf, Usd, UsdPhysics, UsdShade, Vt

from ssilk_core.assets import PLATE_THICKNESS, SurfaceMaterial

from .read_surface import PROPOSAL
from .units import StageUnits

MATERIAL_API, SIM_API = "PhysicsSurfaceDeformableMaterialAPI", "PhysicsSurfaceDeformableSimAPI"
_TYPES = Sdf.ValueTypeNames


def write_surface(prim: Usd.Prim, path: Sdf.Path, surface: SurfaceMaterial) -> None:
    """Define a physics material at a path and bind it to a garment's mesh, whose thickness is the mesh's own.

    A mass for each area becomes a density.
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
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(
        UsdShade.Material(material), UsdShade.Tokens.fallbackStrength, "physics"
    )
