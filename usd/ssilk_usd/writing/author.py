# SPDX-License-Identifier: Apache-2.0
"""The prims of a UsdSkel asset that do not move: skeleton, skinned meshes, blendshapes."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pxr import Gf, Kind, Sdf, Usd, UsdGeom, UsdSkel, Vt

from ssilk_core.errors import fail
from ssilk_core.files import split_location
from ssilk_core.scene.assets import (
    Body,
    Deformer,
    Floats,
    Garment,
    Ints,
    Mesh,
    Motion,
    ProxyRig,
    Skeleton,
    SkinWeights,
)
from ssilk_core.scene.kinematics import local_transforms, sorted_influences, world_transforms

from ..names import CLASS, LBS_SKIN, LEVEL, PIN, PROXIES, RIDER_JOINTS, RIDES_ON, STIFFNESS, shape_name
from ..opening.garment_api import GarmentRecord, apply_garment_api
from ..reading.mesh import display_colour
from ..reading.skin import leaf
from ..units import StageUnits
from .asset_info import AssetInfo, author_asset_info
from .body_faces import HiddenPolygons, author_faces, hide_polygons
from .left_behind import left_behind
from .look import copy_looks

if TYPE_CHECKING:
    from ssilk_core.scene.riders import RiderJoints


@dataclass(frozen=True)
class Asset:
    """Paths of the prims of an authored asset that a shot animates.

    Attributes:
        root: the SkelRoot.
        garment: the garment's mesh.
        animation: the SkelAnimation; what moves (rotations, translations, blendShapeWeights) has no value yet.
        bodies, body_paths: the bodies whose meshes were written, and the prims of these.
        riders, rider_paths: likewise what rides on the garment.
        rider_shapes: of each rider, offsets by the deformer's blendshapes [m], shape (K, M, 3), or None.
        shapes: the blendshapes that were written, as indices into the deformer's; others move nothing.
        body_shapes: those of bodies, as indices into the motion's shapes, in the animation behind `shapes`.
        left_out: what the meshes lose of their looks, and the character of its parts, for messages; empty where
            nothing.
    """

    root: Sdf.Path
    garment: Sdf.Path
    animation: Sdf.Path
    bodies: tuple[Body, ...]
    body_paths: tuple[Sdf.Path, ...]
    shapes: Ints
    left_out: str = ""
    riders: tuple[Body, ...] = ()
    rider_paths: tuple[Sdf.Path, ...] = ()
    rider_shapes: tuple[Floats | None, ...] = ()
    body_shapes: tuple[int, ...] = ()


def define_asset(
    stage: Usd.Stage,
    deformer: Deformer,
    bodies: tuple[Body, ...],
    units: StageUnits,
    *,
    riders: RiderJoints | None = None,
    name: str | None = None,
    record: GarmentRecord | None = None,
    info: AssetInfo | None = None,
    hidden_polygons: HiddenPolygons | None = None,
    output: str | Path = "",
) -> Asset:
    """Define SkelRoot, Skeleton, SkelAnimation, the garment's mesh with its blendshapes, and body meshes.

    Args:
        riders: what rides on the garment; the deformer has its joints.
        name: of the SkelRoot (default: the character's).
        record: how the garment was made, kept on its mesh.
        info: of the SkelRoot as an asset, under its own name; None for none.
        hidden_polygons: polygons of the bodies to hide.
        output: where the layer will lie, which paths of textures are relative to.

    Raises:
        SsilkError: the joint paths spell another hierarchy than the parents.
    """
    scene, ridden = deformer.scene, riders.bodies if riders else ()
    meshes = [scene.garment.mesh.path, *(body.mesh.path for body in (*bodies, *ridden))]
    names = prim_names(["Skeleton", "Animation", *meshes])
    root = UsdSkel.Root.Define(stage, "/" + (name or prim_names([scene.character.path])[0]))
    paths = [root.GetPath().AppendChild(name) for name in names]
    skeleton = define_skeleton(stage, paths[0], scene.character.skeleton, scene.rig, units)
    shapes = np.flatnonzero(deformer.shapes.any(axis=(1, 2)))
    shape_names = [shape_name(index) for index in shapes]
    _define_animation(stage, paths[1], scene.joint_names, shape_names)
    _bind_root(root, skeleton, paths[1])
    if info is not None:
        author_asset_info(root.GetPrim(), root.GetPrim().GetName(), info)
    garment = define_mesh(stage, paths[2], scene.garment.mesh, units)
    mark_garment(garment.GetPrim(), scene.garment, scene.rig.joint_names or None)
    apply_garment_api(garment.GetPrim(), record)
    bind_skin(garment, deformer.skin, skeleton)
    define_blendshapes(garment, shape_names, deformer.shapes[shapes], units)
    body_paths, rider_paths = paths[3 : 3 + len(bodies)], paths[3 + len(bodies) :]
    for path, body in zip(paths[3:], (*bodies, *ridden)):
        mesh = define_mesh(stage, path, body.mesh, units)
        bind_skin(mesh, body.skin, skeleton)
        if body.purpose != UsdGeom.Tokens.default_:
            mesh.CreatePurposeAttr(body.purpose)
    for path, offsets in zip(rider_paths, riders.shapes if riders else ()):
        prim = stage.GetPrimAtPath(path)
        prim.CreateRelationship(RIDES_ON, False).SetTargets([paths[2]])
        define_rider_shapes(UsdGeom.Mesh(prim), offsets, shapes, units)
    if riders and riders.names:
        _author_names(garment.GetPrim(), RIDER_JOINTS, riders.names)
    written = [scene.garment.mesh, *(body.mesh for body in (*bodies, *ridden))]
    source = split_location(scene.character.path)[0]
    left = copy_looks(stage, root.GetPath(), source, list(zip(written, paths[2:])), output)
    if bodies:  # without any, the garment alone is asked for
        left.add(root.GetPrim().GetName(), *left_behind(scene.character, written))
    if hidden_polygons is not None:
        hide_polygons(stage, root.GetPath(), body_paths, [body.mesh for body in bodies], hidden_polygons)
    return Asset(
        root.GetPath(), paths[2], paths[1], bodies, tuple(body_paths), shapes, str(left), ridden,
        tuple(rider_paths), riders.shapes if riders else (),
    )  # fmt: skip


def define_body_shapes(
    stage: Usd.Stage, asset: Asset, motion: Motion, units: StageUnits, *, before: Sequence[str] = ()
) -> Asset:
    """Define the blendshapes by which a motion shapes the bodies of an asset, and let its SkelAnimation weigh them.

    Shapes of one name and course have one weight, such as those of a body and its lashes.

    Args:
        before: blendshapes that the animation weighs, in front.

    Returns:
        The asset with what the animation weighs of the motion's shapes.
    """
    courses: dict[str, int] = {}
    for body, path in enumerate(asset.body_paths):
        own: dict[str, Floats] = {}
        prim = stage.OverridePrim(path) if any(shape.body == body for shape in motion.shapes) else None
        there = {child.GetName() for child in prim.GetAllChildren()} if prim else set()
        for index, shape in enumerate(motion.shapes):
            if shape.body != body or motion.shape_weights is None:
                continue
            name, course = _identifier(shape.name), motion.shape_weights[:, index]
            known = courses.get(name)
            if name in {*there, *own} or known is None or (course != motion.shape_weights[:, known]).any():
                name = free_name(name, {*before, *courses, *there, *own})
                courses[name] = index
            own[name] = np.zeros((asset.bodies[body].mesh.vertex_count, 3))
            own[name][shape.rows] = shape.offsets
        if prim:
            define_blendshapes(UsdGeom.Mesh(prim), list(own), np.array(list(own.values())), units)
    if courses:
        animation = UsdSkel.Animation(stage.GetPrimAtPath(asset.animation))
        animation.CreateBlendShapesAttr(Vt.TokenArray([*before, *courses]))
        animation.CreateBlendShapeWeightsAttr()
    return replace(asset, body_shapes=tuple(courses.values()))


def _identifier(name: str) -> str:
    """Return a name as prims may have it."""
    return re.sub(r"^(\d|$)", r"_\1", re.sub(r"\W", "_", name))


def prim_names(paths: Sequence[str]) -> list[str]:
    """Return a valid and unique prim name for each path, based on its last element."""
    names: list[str] = []
    for path in paths:
        word = re.search(r"\w+", path.rsplit("/", 1)[-1])
        stem = re.sub(r"^(\d|$)", r"_\1", word.group() if word else "")
        names.append(free_name(stem, names))
    return names


def free_name(stem: str, taken: Collection[str]) -> str:
    """Return a name that is not taken: `stem`, or the first of `stem`_2, `stem`_3 and so on."""
    copies = (f"{stem}_{copy}" for copy in count(2))
    return stem if stem not in taken else next(name for name in copies if name not in taken)


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
    """Make the SkelRoot the default prim and a component, and bind skeleton and animation to it."""
    prim = root.GetPrim()
    prim.GetStage().SetDefaultPrim(prim)
    Usd.ModelAPI(prim).SetKind(Kind.Tokens.component)
    root.CreateExtentAttr()
    binding = UsdSkel.BindingAPI.Apply(prim)
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateAnimationSourceRel().SetTargets([animation])


def define_skeleton(
    stage: Usd.Stage, path: Sdf.Path, skeleton: Skeleton, rig: ProxyRig | None, units: StageUnits
) -> UsdSkel.Skeleton:
    """Define the character's joints followed by the proxies, at their bind and rest transforms.

    Raises:
        SsilkError: the joint paths spell another hierarchy than the parents.
    """
    joints, parents, binds = skeleton.joint_names, skeleton.parents, skeleton.bind_transforms
    if rig is not None:
        joints, parents = (*joints, *rig.joint_names), np.concatenate([parents, rig.parents])
        binds = np.concatenate([binds, rig.bind_transforms])
    wrong = np.flatnonzero(np.array(UsdSkel.Topology(joints).GetParentIndices()) != parents)
    if wrong.size:
        fail(
            skeleton.path if rig is None else rig.path,
            f"the path of joint '{joints[wrong[0]]}' does not spell its parent",
            "UsdSkel reads the hierarchy from the joint paths",
            "name each joint '<path of its parent>/<name>'",
        )
    prim = UsdSkel.Skeleton.Define(stage, path)
    prim.CreateJointsAttr(Vt.TokenArray(joints))
    prim.CreateJointNamesAttr(Vt.TokenArray(unique_names(joints)))
    prim.CreateBindTransformsAttr(matrix_array(units.transforms_from_core(binds)))
    prim.CreateRestTransformsAttr(matrix_array(_rest_transforms(skeleton, binds, parents, units)))
    UsdSkel.BindingAPI.Apply(prim.GetPrim())
    return prim


def unique_names(joints: Sequence[str]) -> list[str]:
    """Return a name of its own for each joint path: its last part, numbered where several joints have it."""
    leaves = [leaf(joint) for joint in joints]
    names, taken = dict.fromkeys(leaves), set(leaves)
    found = []
    for name in leaves:
        own = name if name in names else free_name(name, taken)
        names.pop(name, None)  # the first joint of a name keeps it
        taken.add(own)
        found.append(own)
    return found


def _rest_transforms(skeleton: Skeleton, binds: Floats, parents: Ints, units: StageUnits) -> Floats:
    """Return joint-to-parent rest transforms in stage units; those of proxies follow from their bind transforms."""
    proxies = local_transforms(binds, parents)[skeleton.joint_count :]
    world = world_transforms(np.concatenate([skeleton.rest_transforms, proxies]), parents)
    return local_transforms(units.transforms_from_core(world), parents)


def matrix_array(transforms: Floats) -> Vt.Matrix4dArray:
    """Convert column-vector transforms (N, 4, 4) to USD's row-vector matrices."""
    return Vt.Matrix4dArray.FromNumpy(np.ascontiguousarray(np.swapaxes(transforms, -1, -2), dtype=np.float64))


def define_mesh(stage: Usd.Stage, path: Sdf.Path, mesh: Mesh, units: StageUnits) -> UsdGeom.Mesh:
    """Define a mesh at its bind pose, with its own polygons and texture coordinates.

    Without normals, which would not turn with it, viewers shade it smoothly as a subdivision surface: USD's default.
    """
    points = np.asarray(units.points_from_core(mesh.points), dtype=np.float32)
    prim = UsdGeom.Mesh.Define(stage, path)
    prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    author_faces(prim, mesh)
    prim.CreateExtentAttr(extent_array(points.min(axis=0), points.max(axis=0)))
    return prim


def extent_array(low: Floats, high: Floats) -> Vt.Vec3fArray:
    """Return a bounding box as an extent."""
    return Vt.Vec3fArray.FromNumpy(np.stack([low, high]).astype(np.float32))


def mark_garment(prim: Usd.Prim, garment: Garment, proxies: Sequence[str] | None) -> None:
    """Author a garment's vertex classes, what finds them, its stiffness, the paths of its proxies, each unless None.

    Its colour is authored where the prim has none, and that both sides are seen where it says nothing of that.
    """
    if garment.colour is not None and display_colour(prim) is None:
        UsdGeom.Gprim(prim).CreateDisplayColorAttr([Gf.Vec3f(*garment.colour)])
    if not UsdGeom.Gprim(prim).GetDoubleSidedAttr().HasAuthoredValue():
        UsdGeom.Gprim(prim).CreateDoubleSidedAttr(True)  # cloth is seen from both sides
    if garment.classes is not None:
        _author_rows(prim, CLASS, garment.classes[:, None].astype(np.int32))
    if garment.pins is not None:
        _author_rows(prim, PIN, garment.pins[:, None].astype(np.int32))
    if garment.levels is not None:
        _author_rows(prim, LEVEL, garment.levels[:, None].astype(np.float32))
    if garment.mesh.stiffness is not None:
        _author_rows(prim, STIFFNESS, garment.mesh.stiffness[:, None].astype(np.float32))
    if proxies is not None:
        _author_names(prim, PROXIES, proxies)


def keep_lbs_skin(prim: Usd.Prim, skin: SkinWeights, joints: Sequence[str]) -> None:
    """Author a garment's LBS weights over the character's joints, in addition to those of its rig."""
    _author_names(prim, LBS_SKIN[2], joints)
    for name, rows in zip(LBS_SKIN[:2], sorted_influences(skin)):
        _author_rows(prim, name, rows)


def _author_names(prim: Usd.Prim, name: str, names: Sequence[str]) -> None:
    """Author a uniform list of names."""
    attribute = prim.CreateAttribute(name, Sdf.ValueTypeNames.TokenArray, False, Sdf.VariabilityUniform)
    attribute.Set(Vt.TokenArray(list(names)))


def _author_rows(prim: Usd.Prim, name: str, rows: np.ndarray) -> None:
    """Author a vertex primvar of integers or floats, shape (V, elementSize)."""
    whole = np.issubdtype(rows.dtype, np.integer)
    kind = Sdf.ValueTypeNames.IntArray if whole else Sdf.ValueTypeNames.FloatArray
    array = (Vt.IntArray if whole else Vt.FloatArray).FromNumpy(np.ascontiguousarray(rows).reshape(-1))
    primvar = UsdGeom.PrimvarsAPI(prim).CreatePrimvar(name.removeprefix("primvars:"), kind, UsdGeom.Tokens.vertex)
    if rows.shape[1] > 1:
        primvar.SetElementSize(rows.shape[1])
    primvar.Set(array)


def bind_skin(mesh: UsdGeom.Mesh, skin: SkinWeights, skeleton: UsdSkel.Skeleton) -> None:
    """Bind a mesh to a skeleton; influences are sorted, padded with zeros, and sum to one in float32."""
    indices, weights = sorted_influences(skin)
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    width = indices.shape[1]
    binding.CreateJointIndicesPrimvar(False, width).Set(Vt.IntArray.FromNumpy(indices.reshape(-1)))
    binding.CreateJointWeightsPrimvar(False, width).Set(Vt.FloatArray.FromNumpy(weights.reshape(-1)))
    binding.CreateGeomBindTransformAttr(Gf.Matrix4d(1))


def define_blendshapes(
    mesh: UsdGeom.Mesh, names: Sequence[str], offsets: Floats, units: StageUnits, *, before: Sequence[str] = ()
) -> None:
    """Define blendshapes below a bound mesh, with only the nonzero rows of their offsets [m], shape (K, V, 3).

    Args:
        before: blendshapes that the mesh has already, which stay in front.
    """
    if not names:
        return
    binding, path = UsdSkel.BindingAPI(mesh), mesh.GetPath()
    stage = mesh.GetPrim().GetStage()
    for name, shape in zip(names, offsets):
        rows = np.flatnonzero(shape.any(axis=1))
        moved = np.asarray(units.points_from_core(shape[rows]), dtype=np.float32)
        prim = UsdSkel.BlendShape.Define(stage, path.AppendChild(name))
        prim.CreateOffsetsAttr(Vt.Vec3fArray.FromNumpy(moved))
        prim.CreatePointIndicesAttr(Vt.IntArray.FromNumpy(rows.astype(np.int32)))
    names = [*before, *names]
    binding.CreateBlendShapesAttr(Vt.TokenArray(names))
    binding.CreateBlendShapeTargetsRel().SetTargets([path.AppendChild(name) for name in names])


def define_rider_shapes(
    mesh: UsdGeom.Mesh, offsets: Floats | None, shapes: Ints, units: StageUnits, *, before: Sequence[int] | Ints = ()
) -> None:
    """Define those blendshapes of a rider that move it, of some of its garment's.

    Args:
        offsets: by all of the garment's blendshapes [m], shape (K, M, 3); None where it is rigid.
        before: those of the garment that were defined already.
    """
    if offsets is None:
        return
    own, there = ([index for index in each if offsets[index].any()] for each in (shapes, before))
    names = [shape_name(index) for index in own]
    define_blendshapes(mesh, names, offsets[own], units, before=[shape_name(index) for index in there])
