# SPDX-License-Identifier: GPL-3.0-or-later
"""A dressed character to a stage.

Written with `pxr` rather than exported by Blender: its exporter renames `primvars:ssilk:class`, drops modifiers
after the armature and knows no proxies. Nothing has a transform of its own; all points and bind transforms are in
world space, and the rest pose is the bind pose.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt

from .arrays import Dressed, Joints, Shape, influences, to_parents
from .names import identifiers, joint_paths

ROOT = Sdf.Path("/Character")
CLASS = "primvars:ssilk:class"
GARMENT = "ssilk:garment"
PROXIES = "ssilk:proxyJoints"
PLAIN = ("primvars:ssilk:plainJointIndices", "primvars:ssilk:plainJointWeights", "ssilk:plainJoints")
SKIN = ("primvars:skel:jointIndices", "primvars:skel:jointWeights")


def write_stage(dressed: Dressed, path: Path) -> dict[str, str]:
    """Write a dressed character; return the prim path of each mesh by the name of its object.

    Args:
        path: the file to make: .usdc, .usd or .usda.
    """
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, dressed.meters_per_unit)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    root = UsdSkel.Root.Define(stage, ROOT)
    stage.SetDefaultPrim(root.GetPrim())
    skeleton = _define_skeleton(stage, dressed.joints)
    UsdSkel.BindingAPI.Apply(root.GetPrim()).CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    shapes = (dressed.garment, *dressed.bodies)
    names = identifiers((shape.name for shape in shapes), taken=("Skeleton",))
    prims = [_define_mesh(stage, ROOT.AppendChild(name), shape, skeleton) for name, shape in zip(names, shapes)]
    _mark_garment(prims[0], dressed)
    stage.GetRootLayer().Save()
    return {shape.name: str(prim.GetPath()) for shape, prim in zip(shapes, prims)}


def _define_skeleton(stage: Usd.Stage, joints: Joints) -> UsdSkel.Skeleton:
    skeleton = UsdSkel.Skeleton.Define(stage, ROOT.AppendChild("Skeleton"))
    skeleton.CreateJointsAttr(Vt.TokenArray(joint_paths(joints.names, joints.parents)))
    skeleton.CreateBindTransformsAttr(matrices(joints.binds))
    skeleton.CreateRestTransformsAttr(matrices(to_parents(joints.binds, joints.parents)))
    return skeleton


def matrices(transforms: np.ndarray) -> Vt.Matrix4dArray:
    """Return column-vector transforms as USD holds them, for row vectors."""
    return Vt.Matrix4dArray.FromNumpy(np.ascontiguousarray(transforms.swapaxes(-1, -2), dtype=np.float64))


def _define_mesh(stage: Usd.Stage, path: Sdf.Path, shape: Shape, skeleton: UsdSkel.Skeleton) -> Usd.Prim:
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(shape.points, dtype=np.float32)))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(shape.counts.astype(np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(shape.corners.astype(np.int32)))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    if shape.inside_out:
        mesh.CreateOrientationAttr(UsdGeom.Tokens.leftHanded)
    prim = mesh.GetPrim()
    if shape.uvs is not None:
        uvs = Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(shape.uvs, dtype=np.float32))
        kind = Sdf.ValueTypeNames.TexCoord2fArray
        UsdGeom.PrimvarsAPI(prim).CreatePrimvar("st", kind, UsdGeom.Tokens.faceVarying).Set(uvs)
    if shape.weights is not None:
        binding = UsdSkel.BindingAPI.Apply(prim)
        binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
        binding.CreateGeomBindTransformAttr(Gf.Matrix4d(1))
        _author_influences(prim, SKIN, shape.weights)
    return prim


def _mark_garment(prim: Usd.Prim, dressed: Dressed) -> None:
    """Author classes, proxies and the weights beside them, and that this mesh is the garment."""
    prim.CreateAttribute(GARMENT, Sdf.ValueTypeNames.Bool).Set(True)
    if dressed.classes is not None:
        _author_rows(prim, CLASS, dressed.classes[:, None].astype(np.int32))
    paths = joint_paths(dressed.joints.names, dressed.joints.parents)
    own = dressed.joints.character_count
    if dressed.joints.proxy_count:
        _author_names(prim, PROXIES, paths[own:])
    if dressed.plain is not None:
        _author_names(prim, PLAIN[2], paths[:own])
        _author_influences(prim, PLAIN[:2], dressed.plain)


def _author_names(prim: Usd.Prim, name: str, names: list[str]) -> None:
    kind = Sdf.ValueTypeNames.TokenArray
    prim.CreateAttribute(name, kind, False, Sdf.VariabilityUniform).Set(Vt.TokenArray(names))


def _author_influences(prim: Usd.Prim, names: tuple[str, ...], weights: np.ndarray) -> None:
    for name, rows in zip(names, influences(weights)):
        _author_rows(prim, name, rows)


def _author_rows(prim: Usd.Prim, name: str, rows: np.ndarray) -> None:
    """Author a vertex primvar of whole numbers or floats, shape (V, elementSize)."""
    whole = np.issubdtype(rows.dtype, np.integer)
    kind = Sdf.ValueTypeNames.IntArray if whole else Sdf.ValueTypeNames.FloatArray
    array = (Vt.IntArray if whole else Vt.FloatArray).FromNumpy(np.ascontiguousarray(rows).reshape(-1))
    primvar = UsdGeom.PrimvarsAPI(prim).CreatePrimvar(name.removeprefix("primvars:"), kind, UsdGeom.Tokens.vertex)
    primvar.SetElementSize(rows.shape[1])
    primvar.Set(array)
