# SPDX-License-Identifier: Apache-2.0
"""Write proxy rigs: joints appended to the skeleton, listed in the garment's `ssilk:proxyJoints`.

`reading.rig` reads them back, and says which joints are proxies after a rig was edited by hand.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdSkel, Vt

from ssilk_core.errors import fail
from ssilk_core.files import split_body, split_location
from ssilk_core.scene.assets import Floats, Garment, Scene

from ..names import CLASS, FROM_JOINTS, LBS_SKIN, LEVEL, ONTO_JOINTS, PIN, SKEL, STIFFNESS
from ..opening.garment_api import apply_garment_api
from ..opening.stage import (
    PRIMS,
    apply,
    inherited,
    location,
    open_stage,
    value,
)
from ..reading.carried import carried_by
from ..reading.garment import fitted_skeleton, garment_place
from ..reading.joint_scales import divided, without_scales
from ..reading.mesh import is_garment
from ..reading.shapes import shape_offsets
from ..reading.skeleton import find_skeleton
from ..reading.skin import leaf
from ..reading.spaces import SkelSource
from ..reading.surface import bound_material
from ..units import StageUnits
from .author import bind_skin, define_mesh, free_name, keep_lbs_skin, mark_garment, matrix_array, prim_names
from .export import export, need_layer_suffix
from .look import anchor_tiles, copy_looks, name_files_from, variants_of
from .look_above import LookFromAbove
from .repair_mesh import offset_points
from .surface import reads_as, shield_surface, write_surface

SAME_SHAPE = 1e-7  # of a garment's size, by which its points may differ and are left as they are


def write_rigged_stage(
    source: str | Path,
    scene: Scene,
    out: str | Path,
    *,
    moved: Floats | None = None,
    stands_for: Mapping[str, str] | None = None,
) -> str:
    """Write a flattened copy of the character's stage with the garment bound to its proxy rig.

    The copy keeps the stage's units and axes. Proxies are appended to the skeleton's joints, in place of older ones
    of the same garment. The garment's mesh stands under the SkelRoot with its classes, the rig's weights, and the
    LBS weights over the character beside them (`primvars:ssilk:plainJointIndices` and `...Weights`). Where the mesh
    would lose its physics material, or take another one from where it stands, it is bound to its own.

    Args:
        source: the stage that `scene.character` was read from.
        scene: the character, its garment (from the same stage or from another file) and the rig.
        out: the file to write: .usdc, .usd or .usda.
        moved: how far the garment's points are from where its file has them [m], shape (V, 3); None if nowhere.
        stands_for: for each joint of the character that the garment was made on the one of this character that stands
            for it, or "": the garment keeps it for bakes of a model that was trained there. None for its own.

    Returns:
        What the copy loses: variants that are not selected, and of the garment's look where it is copied or moved;
        for messages, empty where nothing.

    Raises:
        SsilkError: the output cannot be written.
    """
    need_layer_suffix(out)
    layer, variants = _flattened(source, scene)
    stage = Usd.Stage.Open(layer)
    skel = find_skeleton(stage, root=_prim_path(scene.character.skeleton.path))
    old, left_out, wanted = _in_stage(stage, source, scene.garment), "", None
    look = LookFromAbove.of(old) if old else None
    if old:
        is_shaped = bool(split_body(str(source))[1])
        mesh, to_bind, wanted = _place_garment(stage, skel, old, scene, moved, is_shaped)
    else:
        mesh, left_out = _copy_garment(stage, skel, scene.garment, out)
        to_bind = np.eye(4)
    _keep_surface(mesh.GetPrim(), skel, scene.garment, moved)
    proxies = _append_proxies(skel, str(mesh.GetPath()), scene)
    _bind_garment(mesh, to_bind, skel, scene, proxies)
    if stands_for is not None:
        for name, values in ((FROM_JOINTS, stands_for.keys()), (ONTO_JOINTS, stands_for.values())):
            attribute = mesh.GetPrim().CreateAttribute(name, Sdf.ValueTypeNames.TokenArray, False)
            attribute.SetVariability(Sdf.VariabilityUniform)
            attribute.Set(Vt.TokenArray(list(values)))
    if wanted is not None:
        _shape_garment(mesh, skel, wanted)
    if look:
        left_out = look.keep(mesh.GetPrim())
    name_files_from(layer, out)
    export(layer, out)
    return "; ".join(filter(None, [*variants, left_out]))


def _flattened(source: str | Path, scene: Scene) -> tuple[Sdf.Layer, list[str]]:
    """Flatten the source into one layer, without instances on the paths of the rig; also say what that loses."""
    stage = open_stage(source)
    stage.SetEditTarget(stage.GetSessionLayer())
    for path in (_prim_path(scene.character.path), _prim_path(scene.garment.mesh.path)):
        for prefix in Sdf.Path(path).GetPrefixes():
            _expand(stage.GetPrimAtPath(prefix))
    top = stage.GetPrimAtPath(_prim_path(scene.character.path))
    while instances := [prim for prim in Usd.PrimRange(top) if prim.IsInstance()]:
        for prim in instances:
            _expand(prim)
    lost = [
        f"{prim.GetName()} loses {', '.join(variants)}"
        for prim in Usd.PrimRange(stage.GetPseudoRoot(), PRIMS)
        if (variants := variants_of(prim))
    ]
    flat = stage.Flatten()
    anchor_tiles(stage, flat)
    return flat, lost


def _expand(prim: Usd.Prim) -> None:
    if prim and prim.IsInstance():
        prim.SetInstanceable(False)


def _prim_path(where: str) -> str:
    return split_location(where)[1] or where


def _in_stage(stage: Usd.Stage, source: str | Path, garment: Garment) -> Usd.Prim | None:
    """Return the mesh of a garment that was read from the character's stage; None for one from its own file."""
    file, path = split_location(garment.mesh.path)
    old = stage.GetPrimAtPath(path or "/")
    here, there = Path(split_body(file)[0]), split_body(str(source))[0]
    same = here.exists() and here.samefile(there)
    return old if same and old and old.IsA(UsdGeom.Mesh) else None


def _place_garment(
    stage: Usd.Stage, skel: SkelSource, old: Usd.Prim, scene: Scene, moved: Floats | None, is_shaped: bool
) -> tuple[UsdGeom.Mesh, Floats, Floats | None]:
    """Bring a garment's mesh beneath the SkelRoot, where it stands elsewhere.

    Args:
        is_shaped: whether the stage was opened as another body of it, onto which the garment was carried.

    Returns:
        The mesh; its own space to bind space, shape (4, 4); and where its points are to be once it is bound, with
        the blendshapes that are on then, shape (V, 3): None where they stay as they are.
    """
    garment, skeleton = scene.garment, scene.character.skeleton
    own = fitted_skeleton(old, str(skel.prim.GetPath())) or skel
    place = garment_place(old, own, replace(skeleton, path=location(skel.prim)))
    to_bind = np.linalg.inv(skel.bind_to_core) @ place.to_core
    shaped, wanted = shape_offsets(old, own), None
    if is_shaped or place.moves is not None:  # to its bind pose, which another skeleton has otherwise
        wanted = apply(np.linalg.inv(place.to_core), garment.mesh.points)
    elif moved is not None or shaped is not None:
        wanted = np.array(value(old, "points"), dtype=np.float64) + (0 if shaped is None else shaped)
        wanted += 0 if moved is None else moved @ np.linalg.inv(place.to_core[:3, :3]).T
    if carried_by(old, own):
        old = _let_go(stage, skel, old)
    if not old.GetPath().HasPrefix(skel.root.GetPath()):
        old = _move(stage, old, _free_path(skel, old.GetName()))
    return UsdGeom.Mesh(old), to_bind, wanted


def _shape_garment(mesh: UsdGeom.Mesh, skel: SkelSource, wanted: Floats) -> None:
    """Move the points of a bound garment so that they are where they are `wanted`, (V, 3), in its own space.

    Blendshapes that its new skeleton has on add to them; those that only its old one had on no longer do.
    """
    on = shape_offsets(mesh.GetPrim(), skel)
    offsets = wanted - np.array(value(mesh.GetPrim(), "points"), dtype=np.float64) - (0 if on is None else on)
    if np.abs(offsets).max() > SAME_SHAPE * np.ptp(wanted, axis=0).max():
        offset_points(mesh, offsets)


def _keep_surface(prim: Usd.Prim, skel: SkelSource, garment: Garment, moved: Floats | None) -> None:
    """Bind the mesh to a physics material of its own where what it inherits is not what the garment was read with."""
    surface, mesh = garment.surface, garment.mesh
    if moved is not None:  # a mass for each area was read over the area before
        mesh = replace(mesh, points=mesh.points - moved)
    if reads_as(prim, mesh, surface):
        return
    path = _free_path(skel, leaf(surface.path) if surface else f"{prim.GetName()}_without_physics")
    if surface is None:
        shield_surface(prim, path)
    else:
        write_surface(prim, path, surface)
    bound = bound_material(prim)
    if not (bound and bound.GetPath() == path):
        fail(
            location(prim),
            "a physics material is bound above it, stronger than descendants or by a collection",
            "beneath the SkelRoot the garment would lose its own",
            "weaken that binding, or bind the garment's material in the same way",
        )


def _let_go(stage: Usd.Stage, skel: SkelSource, prim: Usd.Prim) -> Usd.Prim:
    """Take the xforms from a mesh that its joint moves from now on; move it where others hang on them too."""
    above = prim
    while above != skel.root and not above.IsPseudoRoot():
        if any(_is_beside(other.GetPath(), prim.GetPath()) for other in Usd.PrimRange(above)):
            return _move(stage, prim, _free_path(skel, prim.GetName()))
        UsdGeom.Xformable(above).ClearXformOpOrder()
        above = above.GetParent()
    return prim


def _is_beside(path: Sdf.Path, own: Sdf.Path) -> bool:
    """Return whether a path is neither above another one nor below it."""
    return not (own.HasPrefix(path) or path.HasPrefix(own))


def _copy_garment(stage: Usd.Stage, skel: SkelSource, garment: Garment, out: str | Path) -> tuple[UsdGeom.Mesh, str]:
    """Define the garment below the SkelRoot in the stage's bind space, and say what its look loses.

    An older copy is replaced.
    """
    name = prim_names([garment.mesh.path])[0]
    older = stage.GetPrimAtPath(skel.root.GetPath().AppendChild(name))
    if older and is_garment(older):
        stage.RemovePrim(older.GetPath())
    points = apply(np.linalg.inv(skel.bind_to_core), garment.mesh.points)
    path, file = _free_path(skel, name), split_location(garment.mesh.path)[0]
    mesh = define_mesh(stage, path, replace(garment.mesh, points=points), StageUnits())
    left = copy_looks(stage, skel.root.GetPath(), file, [(garment.mesh, path)], out)
    return mesh, str(left)


def _free_path(skel: SkelSource, name: str) -> Sdf.Path:
    taken = [str(child.GetPath()) for child in skel.root.GetAllChildren()]
    return skel.root.GetPath().AppendChild(prim_names([*taken, name])[-1])


def _move(stage: Usd.Stage, prim: Usd.Prim, to: Sdf.Path) -> Usd.Prim:
    editor = Usd.NamespaceEditor(stage)  # which takes along what names it, such as collections
    editor.MovePrimAtPath(prim.GetPath(), to)
    editor.ApplyEdits()
    return stage.GetPrimAtPath(to)


def _append_proxies(skel: SkelSource, garment: str, scene: Scene) -> tuple[str, ...]:
    """Replace the garment's joints in the skeleton by those of the rig; return the proxies' joint paths."""
    kept = [index for index, owner in enumerate(skel.owners) if owner != garment]
    if len(kept) < len(skel.joints):
        _keep_joint_names(skel)
    joints = tuple(skel.joints[index] for index in kept)
    proxies = _proxy_paths(scene, joints)
    binds = skel.binds_from_core(scene.rig.bind_transforms)
    bind = np.concatenate([divided(skel.bind, 1 / skel.scales)[kept], binds])
    own = skel.binds_from_core(scene.character.skeleton.bind_transforms)
    combined = np.concatenate([divided(own, 1 / skel.scales[skel.character_joints]), binds])
    rest = np.linalg.inv(combined[scene.rig.parents]) @ binds
    rest = np.concatenate([without_scales(skel.rest, 1 / skel.scales, skel.parents)[kept], rest])
    skeleton = UsdSkel.Skeleton(skel.prim)
    skeleton.CreateJointsAttr(Vt.TokenArray((*joints, *proxies)))
    skeleton.CreateBindTransformsAttr(matrix_array(bind))
    skeleton.CreateRestTransformsAttr(matrix_array(rest))
    names = value(skel.prim, "jointNames")
    if names:
        short = [*(names[index] for index in kept), *map(leaf, proxies)]
        skeleton.CreateJointNamesAttr(Vt.TokenArray(short))
    return proxies


def _keep_joint_names(skel: SkelSource) -> None:
    """Author the joint order on meshes that rely on the skeleton's, before its indices change."""
    for prim in Usd.PrimRange(skel.root, PRIMS):
        if prim.HasAttribute(SKEL[0]) and inherited(prim, "skel:joints") is None:
            UsdSkel.BindingAPI.Apply(prim).CreateJointsAttr(Vt.TokenArray(skel.joints))


def _proxy_paths(scene: Scene, taken: tuple[str, ...]) -> tuple[str, ...]:
    """Return joint paths that match the proxies' parents, with unique leaf names."""
    leaves = {leaf(name) for name in taken}
    paths = list(scene.character.skeleton.joint_names)
    for name, parent in zip(scene.rig.joint_names, scene.rig.parents):
        unique = free_name(leaf(name), leaves)
        leaves.add(unique)
        paths.append(f"{paths[parent]}/{unique}")
    return tuple(paths[scene.character.skeleton.joint_count :])


def _bind_garment(
    mesh: UsdGeom.Mesh, to_bind: Floats, skel: SkelSource, scene: Scene, proxies: tuple[str, ...]
) -> None:
    """Author classes, weights and the list of proxies on the garment's mesh.

    Its own joint order holds the names, so that its weights survive joints that are removed or reordered by hand.
    """
    prim, character_joints = mesh.GetPrim(), scene.character.skeleton.joint_names
    for name in (CLASS, PIN, LEVEL, STIFFNESS, *SKEL, *LBS_SKIN):
        prim.RemoveProperty(name)
        prim.RemoveProperty(f"{name}:indices")  # of an indexed primvar
    apply_garment_api(prim)
    bind_skin(mesh, scene.rig.skin, UsdSkel.Skeleton(skel.prim))
    binding = UsdSkel.BindingAPI(prim)
    binding.CreateGeomBindTransformAttr(Gf.Matrix4d(to_bind.T.tolist()))
    binding.CreateJointsAttr(Vt.TokenArray((*character_joints, *proxies)))
    mark_garment(prim, scene.garment, proxies)
    keep_lbs_skin(prim, scene.lbs_skin, character_joints)
