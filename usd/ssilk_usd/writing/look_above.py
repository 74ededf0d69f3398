# SPDX-License-Identifier: Apache-2.0
"""What a mesh looks like by the prims above it. Moved away, it would lose that, or take on other things."""

from __future__ import annotations

from dataclasses import dataclass

from pxr import Sdf, Usd, UsdGeom, UsdShade

PURPOSES = (UsdShade.Tokens.allPurpose, UsdShade.Tokens.full, UsdShade.Tokens.preview)
OTHER_PRIMVARS = ("primvars:skel:", "primvars:ssilk:")  # which say what moves a mesh


@dataclass(frozen=True)
class LookFromAbove:
    """What a mesh in one layer has from above.

    Attributes:
        path: of the mesh.
        materials: of the mesh and its subsets: path of the prim, purpose of the binding, path of the material if any.
        primvars: paths of attributes.
        purpose: what the mesh is drawn for.
    """

    path: Sdf.Path
    materials: tuple[tuple[Sdf.Path, str, Sdf.Path | None], ...]
    primvars: tuple[Sdf.Path, ...]
    purpose: str

    @classmethod
    def of(cls, prim: Usd.Prim) -> LookFromAbove:
        """Return what a mesh has from above."""
        subsets = UsdGeom.Subset.GetAllGeomSubsets(UsdGeom.Imageable(prim))
        holders = [prim, *(subset.GetPrim() for subset in subsets)]
        materials = [
            (each.GetPath(), purpose, bound_material_path(each, purpose)) for each in holders for purpose in PURPOSES
        ]
        purpose = str(UsdGeom.Imageable(prim).ComputePurpose())
        return cls(prim.GetPath(), tuple(materials), tuple(inherited_primvars(prim)), purpose)

    def keep(self, prim: Usd.Prim) -> str:
        """Author on the mesh, where it was moved to in its layer, what it had from above; return what it loses."""
        if prim.GetPath() == self.path:
            return ""
        stage = prim.GetStage()
        layer = stage.GetEditTarget().GetLayer()
        for path in self.primvars:
            Sdf.CopySpec(layer, path, layer, prim.GetPath().AppendProperty(path.name))
        if UsdGeom.Imageable(prim).ComputePurpose() != self.purpose:
            UsdGeom.Imageable(prim).CreatePurposeAttr(self.purpose)
        lost: dict[str, None] = {}
        for path, purpose, material in self.materials:
            holder = stage.GetPrimAtPath(path.ReplacePrefix(self.path, prim.GetPath()))
            if material and bound_material_path(holder, purpose) != material:
                api = UsdShade.MaterialBindingAPI.Apply(holder)
                api.Bind(UsdShade.Material(stage.GetPrimAtPath(material)), materialPurpose=purpose)
            found = bound_material_path(holder, purpose)
            if found != material:
                had = f"has {material.name}" if material else "has no material"
                lost[f"{holder.GetName()} {had}, and takes on {found.name if found else 'none'} from above"] = None
        return "; ".join(lost)


def inherited_primvars(prim: Usd.Prim) -> list[Sdf.Path]:
    """Return the paths of the primvars that a prim has from those above it, and of the indices of indexed ones."""
    found = []
    for primvar in UsdGeom.PrimvarsAPI(prim).FindPrimvarsWithInheritance():
        attribute = primvar.GetAttr()
        if attribute.GetPrim() != prim and not attribute.GetName().startswith(OTHER_PRIMVARS):
            found += [each.GetPath() for each in (attribute, primvar.GetIndicesAttr()) if each]
    return found


def bound_material_path(prim: Usd.Prim, purpose: str) -> Sdf.Path | None:
    """Return the path of the material that USD binds to a prim."""
    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial(purpose)
    return material.GetPath() if material else None
