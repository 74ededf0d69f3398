# SPDX-License-Identifier: Apache-2.0
"""Which of a mesh's UV sets is its own: what its material reads, by any of the types that USD lets it have."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdShade

from ssilk_core.errors import fail
from ssilk_core.scene.assets import Floats, Ints

from ..opening.stage import EARLIEST, location, value

_USUAL = ("UVMap", "map1", "uv", "uv0", "UV0", "Texture_uv")
_MAPS = (UsdGeom.Tokens.faceVarying, UsdGeom.Tokens.vertex, UsdGeom.Tokens.varying)  # else a value is no mapping
_KINDS = Sdf.ValueTypeNames
_PAIRS = (_KINDS.Float2Array, _KINDS.Double2Array, _KINDS.Half2Array)
_COORDINATES = (
    _KINDS.TexCoord2fArray, _KINDS.TexCoord2dArray, _KINDS.TexCoord2hArray,
    _KINDS.TexCoord3fArray, _KINDS.TexCoord3dArray, _KINDS.TexCoord3hArray,
)  # fmt: skip
# Inputs by which shaders read a primvar of two floats, by how the shaders' identifiers begin.
_READERS = {"UsdPrimvarReader_float2": "varname", "ND_geompropvalue_vector2": "geomprop"}
_PURPOSES = (UsdShade.Tokens.allPurpose, UsdShade.Tokens.full, UsdShade.Tokens.preview)
_COLOURS = ("diffuseColor", "base_color", "baseColor", "diffuse_color")  # inputs of surfaces


def texture_coordinates(prim: Usd.Prim, indices: Ints) -> Floats | None:
    """Return (u, v) for each face corner from the UV set of a mesh, shape (corners, 2), or None."""
    chosen = _uv_set(prim)
    if chosen is None:
        return None
    found = np.array(chosen.ComputeFlattened(EARLIEST), dtype=np.float64)
    uvs = found.reshape(-1, found.shape[-1])[:, :2]  # a third coordinate is of textures in space
    if chosen.GetInterpolation() == UsdGeom.Tokens.faceVarying:
        expected, corners = len(indices), np.arange(len(indices), dtype=np.int64)
    else:
        expected, corners = len(value(prim, "points")), indices.astype(np.int64)
    if len(uvs) != expected:
        fail(
            location(prim),
            f"{chosen.GetName()} holds {len(uvs)} texture coordinates for {expected} "
            f"({chosen.GetInterpolation()} interpolation)",
            "one for each is needed",
            "unwrap the mesh again, or remove them",
        )
    return uvs[corners]


def _uv_set(prim: Usd.Prim) -> UsdGeom.Primvar | None:
    """Return the UV set that the mesh's material reads, else `primvars:st`, else one of a usual name, else any.

    Pairs of plain floats may be anything, and count where they are read or called so.
    """
    found = [each for each in UsdGeom.PrimvarsAPI(prim).GetPrimvarsWithValues() if each.GetInterpolation() in _MAPS]
    named = {str(each.GetPrimvarName()): each for each in found if each.GetTypeName() in (*_COORDINATES, *_PAIRS)}
    meant = [each for each in found if each.GetTypeName() in _COORDINATES]
    wanted = (*_names_read(prim), "st", *_USUAL)
    return next(iter([*(named[name] for name in wanted if name in named), *meant]), None)


def _names_read(prim: Usd.Prim) -> Iterator[str]:
    """Yield the primvars by which the material of a mesh, or those of its subsets, look up textures.

    Those of colours come first: light maps and masks often have sets of their own.
    """
    for holder in (prim, *(subset.GetPrim() for subset in UsdGeom.Subset.GetAllGeomSubsets(UsdGeom.Imageable(prim)))):
        bound = [UsdShade.MaterialBindingAPI(holder).ComputeBoundMaterial(purpose)[0] for purpose in _PURPOSES]
        for output in (output for material in bound if material for output in material.GetSurfaceOutputs()):
            for surface in UsdShade.Utils.GetValueProducingAttributes(output):
                yield from _read_by(UsdShade.Shader(surface.GetPrim()), set())


def _read_by(shader: UsdShade.Shader, seen: set[Sdf.Path]) -> Iterator[str]:
    """Yield the primvars that a shader and those that it is connected to look up."""
    if not shader or shader.GetPath() in seen:
        return
    seen.add(shader.GetPath())
    kind = str(shader.GetIdAttr().Get() or "")
    name = next((name for begin, name in _READERS.items() if kind.startswith(begin)), None)
    for each in sorted(shader.GetInputs(), key=lambda each: each.GetBaseName() not in _COLOURS):
        for attribute in UsdShade.Utils.GetValueProducingAttributes(each):
            if UsdShade.Output.IsOutput(attribute):
                yield from _read_by(UsdShade.Shader(attribute.GetPrim()), seen)
            elif each.GetBaseName() == name and attribute.Get() is not None:
                yield str(attribute.Get())
