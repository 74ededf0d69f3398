# SPDX-License-Identifier: Apache-2.0
"""The prims of a UsdSkel asset that do not move: skeleton, skinned meshes, blendshapes."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import count

import numpy as np
from pxr import Gf, Kind, Sdf, Usd, UsdGeom, UsdSkel, Vt

from ssilk_core.assets import Body, Deformer, Floats, Ints, Mesh, Scene, SkinWeights
from ssilk_core.errors import need
from ssilk_core.kinematics import local_transforms, world_transforms

from .garment_api import GarmentRecord, apply_garment_api
from .read_mesh import CLASS, PROXIES
from .units import StageUnits


@dataclass(frozen=True)
class Asset:
    """Where the moving parts of an authored asset stand.

    Attributes:
        root: the SkelRoot.
        garment: the garment's mesh.
        animation: the SkelAnimation; what moves (rotations, translations, blendShapeWeights) has no value yet.
        bodies: the bodies whose meshes were written.
        shapes: the blendshapes that were written, as indices into the deformer's; others move nothing.
    """

    root: Sdf.Path
    garment: Sdf.Path
    animation: Sdf.Path
    bodies: tuple[Body, ...]
    shapes: Ints


def define_asset(
    stage: Usd.Stage,
    deformer: Deformer,
    bodies: tuple[Body, ...],
    units: StageUnits,
    *,
    name: str | None = None,
    record: GarmentRecord | None = None,
) -> Asset:
    """Define SkelRoot, Skeleton, SkelAnimation, the garment's mesh with its blendshapes, and body meshes.

    Args:
        name: of the SkelRoot (default: the character's).
        record: how the garment was made, kept on its mesh.

    Raises:
        SsilkError: the joint paths spell another hierarchy than the parents.
    """
    scene = deformer.scene
    meshes = [scene.garment.mesh.path, *(body.mesh.path for body in bodies)]
    names = prim_names(["Skeleton", "Animation", *meshes])
    root = UsdSkel.Root.Define(stage, "/" + (name or prim_names([scene.character.path])[0]))
    paths = [root.GetPath().AppendChild(name) for name in names]
    skeleton = _define_skeleton(stage, paths[0], scene, units)
    shapes = np.flatnonzero(deformer.shapes.any(axis=(1, 2)))
    shape_names = [f"shape_{index:03d}" for index in shapes]
    _define_animation(stage, paths[1], scene.joint_names, shape_names)
    _bind_root(root, skeleton, paths[1])
    garment = define_mesh(stage, paths[2], scene.garment.mesh, units)
    _mark_garment(garment, scene)
    apply_garment_api(garment.GetPrim(), record)
    bind_skin(garment, deformer.skin, skeleton)
    _define_blendshapes(garment, shape_names, deformer.shapes[shapes], units)
    for path, body in zip(paths[3:], bodies):
        bind_skin(define_mesh(stage, path, body.mesh, units), body.skin, skeleton)
    return Asset(root.GetPath(), paths[2], paths[1], bodies, shapes)


def prim_names(paths: Sequence[str]) -> list[str]:
    """Return a valid and unique prim name for each path, made from the path's last part."""
    names: list[str] = []
    for path in paths:
        word = re.search(r"\w+", path.rsplit("/", 1)[-1])
        stem = re.sub(r"^(\d|$)", r"_\1", word.group() if word else "")
        copies = (f"{stem}_{copy}" for copy in count(2))
        names.append(stem if stem not in names else next(name for name in copies if name not in names))
    return names


def _define_animation(stage: Usd.Stage, path: Sdf.Path, joints: Sequence[str], shapes: Sequence[str]) -> None:
    animation = UsdSkel.Animation.Define(stage, path)
    animation.CreateJointsAttr(Vt.TokenArray(joints))
    animation.CreateRotationsAttr()
    animation.CreateTranslationsAttr()
    animation.CreateScalesAttr(Vt.Vec3hArray(len(joints), Gf.Vec3h(1)))
    if shapes:
        animation.CreateBlendShapesAttr(Vt.TokenArray(shapes))
        animation.CreateBlendShapeWeightsAttr()


def _bind_root(root: UsdSkel.Root, skeleton: UsdSkel.Skeleton, animation: Sdf.Path) -> None:
    """Make the SkelRoot the component that the stage is about, and bind skeleton and animation to it."""
    prim = root.GetPrim()
    prim.GetStage().SetDefaultPrim(prim)
    Usd.ModelAPI(prim).SetKind(Kind.Tokens.component)
    root.CreateExtentAttr()
    binding = UsdSkel.BindingAPI.Apply(prim)
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateAnimationSourceRel().SetTargets([animation])


def _define_skeleton(stage: Usd.Stage, path: Sdf.Path, scene: Scene, units: StageUnits) -> UsdSkel.Skeleton:
    """Define the character's joints followed by the proxies, at their bind and rest transforms."""
    names = Vt.TokenArray(scene.joint_names)
    spelled = np.array(UsdSkel.Topology(names).GetParentIndices())
    wrong = np.flatnonzero(spelled != scene.parents)
    need(
        wrong.size == 0,
        scene.rig.path,
        f"the path of joint '{scene.joint_names[wrong[0]] if wrong.size else ''}' does not spell its parent",
        "UsdSkel reads the hierarchy from the joint paths",
        "name each joint '<path of its parent>/<name>'",
    )
    skeleton = UsdSkel.Skeleton.Define(stage, path)
    skeleton.CreateJointsAttr(names)
    skeleton.CreateBindTransformsAttr(matrix_array(units.transforms_from_core(scene.bind_transforms)))
    skeleton.CreateRestTransformsAttr(matrix_array(_rest_transforms(scene, units)))
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim())
    return skeleton


def _rest_transforms(scene: Scene, units: StageUnits) -> Floats:
    """Joint to parent at rest in the stage's units: as authored for the character, as bound for the proxies."""
    skeleton = scene.character.skeleton
    proxies = local_transforms(scene.bind_transforms, scene.parents)[skeleton.joint_count :]
    world = world_transforms(np.concatenate([skeleton.rest_transforms, proxies]), scene.parents)
    return local_transforms(units.transforms_from_core(world), scene.parents)


def matrix_array(transforms: Floats) -> Vt.Matrix4dArray:
    """Return column-vector transforms (N, 4, 4) as USD holds them, for row vectors."""
    return Vt.Matrix4dArray.FromNumpy(np.ascontiguousarray(np.swapaxes(transforms, -1, -2), dtype=np.float64))


def define_mesh(stage: Usd.Stage, path: Sdf.Path, mesh: Mesh, units: StageUnits) -> UsdGeom.Mesh:
    """Define a polygon mesh at its bind pose, with its own polygons and texture coordinates."""
    points = np.asarray(units.points_from_core(mesh.points), dtype=np.float32)
    prim = UsdGeom.Mesh.Define(stage, path)
    prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.asarray(mesh.polygon_counts, dtype=np.int32)))
    prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.asarray(mesh.polygon_indices, dtype=np.int32)))
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    prim.CreateExtentAttr(extent_array(points.min(axis=0), points.max(axis=0)))
    if mesh.uvs is not None:
        primvars = UsdGeom.PrimvarsAPI(prim)
        coordinates = primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
        coordinates.Set(Vt.Vec2fArray.FromNumpy(np.asarray(mesh.uvs, dtype=np.float32)))
    return prim


def extent_array(low: Floats, high: Floats) -> Vt.Vec3fArray:
    """Return a bounding box as an extent."""
    return Vt.Vec3fArray.FromNumpy(np.stack([low, high]).astype(np.float32))


def _mark_garment(mesh: UsdGeom.Mesh, scene: Scene) -> None:
    """Author the vertex classes and the names of the proxy joints on the garment's mesh."""
    prim, types = mesh.GetPrim(), Sdf.ValueTypeNames
    classes = UsdGeom.Primvar(prim.CreateAttribute(CLASS, types.IntArray, custom=False))
    classes.SetInterpolation(UsdGeom.Tokens.vertex)
    classes.Set(Vt.IntArray.FromNumpy(scene.classes.astype(np.int32)))
    if scene.rig.proxy_count:
        prim.CreateAttribute(PROXIES, types.TokenArray).Set(Vt.TokenArray(scene.rig.joint_names))


def bind_skin(mesh: UsdGeom.Mesh, skin: SkinWeights, skeleton: UsdSkel.Skeleton) -> None:
    """Bind a mesh to a skeleton; influences sorted by weight, padded with zeros, of sum one in float32."""
    indices, weights = sorted_influences(skin)
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    width = indices.shape[1]
    binding.CreateJointIndicesPrimvar(False, width).Set(Vt.IntArray.FromNumpy(indices.reshape(-1)))
    binding.CreateJointWeightsPrimvar(False, width).Set(Vt.FloatArray.FromNumpy(weights.reshape(-1)))
    binding.CreateGeomBindTransformAttr(Gf.Matrix4d(1))


def sorted_influences(skin: SkinWeights) -> tuple[np.ndarray, np.ndarray]:
    """Return joint indices (int32) and weights (float32), heaviest first, each joint once, shape (V, I)."""
    # By way of the dense matrix a joint that a row names twice is added up, where Blender keeps the last one only.
    merged = SkinWeights.from_dense(skin.path, skin.dense(int(skin.indices.max()) + 1))
    weights = merged.weights.astype(np.float32)
    # Far from the origin an error in the sum moves the vertex: let the heaviest weight take up the rounding.
    weights[:, 0] = 1 - weights[:, 1:].sum(axis=1, dtype=np.float64)
    return np.ascontiguousarray(merged.indices), weights


def _define_blendshapes(mesh: UsdGeom.Mesh, names: Sequence[str], offsets: Floats, units: StageUnits) -> None:
    """Define blendshapes beneath a bound mesh, storing only the rows that move; offsets [m], shape (K, V, 3)."""
    if not names:
        return
    binding, path = UsdSkel.BindingAPI(mesh), mesh.GetPath()
    stage = mesh.GetPrim().GetStage()
    for name, shape in zip(names, offsets):
        rows = np.flatnonzero(shape.any(axis=1))
        moved = np.asarray(units.vectors_from_core(shape[rows]), dtype=np.float32)
        prim = UsdSkel.BlendShape.Define(stage, path.AppendChild(name))
        prim.CreateOffsetsAttr(Vt.Vec3fArray.FromNumpy(moved))
        prim.CreatePointIndicesAttr(Vt.IntArray.FromNumpy(rows.astype(np.int32)))
    binding.CreateBlendShapesAttr(Vt.TokenArray(names))
    binding.CreateBlendShapeTargetsRel().SetTargets([path.AppendChild(name) for name in names])
