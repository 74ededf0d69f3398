# SPDX-License-Identifier: Apache-2.0
"""Write characters with garments, garments and motions as files of their own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from pxr import Gf, Kind, Sdf, Usd, UsdGeom, UsdSkel, Vt

from ssilk_core.files import replacing
from ssilk_core.scene.assets import Character, Floats, Garment, Ints, Mesh, Motion, ProxyRig, ShotWorld, Skeleton

from ..names import FREE, GARMENT, HOLD
from ..opening.garment_api import GarmentRecord, apply_garment_api
from ..units import StageUnits
from .author import bind_skin, define_mesh, define_skeleton, keep_lbs_skin, mark_garment, prim_names
from .export import new_stage, save
from .world import define_world

CORE_UNITS = StageUnits(1.0, UsdGeom.Tokens.y)


def write_scene(
    path: str | Path, character: Character, garment: Garment, rig: ProxyRig | None = None, *, units: StageUnits
) -> None:
    """Write a character with a garment at its bind pose, as `read_scene` reads them.

    SkelRoot, Skeleton and meshes are named after the last parts of their paths. Weights, classes and proxies are
    left out where there are none; the garment's weights over the character's joints stand beside those of its rig.

    Args:
        path: the file to write: .usdc, .usd or .usda.
        units: units and up axis of the stage.

    Raises:
        SsilkError: the joint paths spell another hierarchy than the parents, or the file cannot be written.
    """
    skeleton, bodies = character.skeleton, character.bodies
    with replacing(path) as temporary:
        stage = new_stage(temporary, units)
        root = UsdSkel.Root.Define(stage, _root_path(character.path))
        stage.SetDefaultPrim(root.GetPrim())
        names = prim_names([skeleton.path, garment.mesh.path, *(body.mesh.path for body in bodies)])
        paths = [root.GetPath().AppendChild(name) for name in names]
        joints = define_skeleton(stage, paths[0], skeleton, rig, units)
        UsdSkel.BindingAPI.Apply(root.GetPrim()).CreateSkeletonRel().SetTargets([joints.GetPath()])
        mesh = define_mesh(stage, paths[1], garment.mesh, units)
        skin = garment.skin if rig is None else rig.skin
        if skin is not None:
            bind_skin(mesh, skin, joints)
        mesh.GetPrim().CreateAttribute(GARMENT, Sdf.ValueTypeNames.Bool).Set(True)
        mark_garment(mesh.GetPrim(), garment, None if rig is None else rig.joint_names)
        if rig is not None and garment.skin is not None:
            keep_lbs_skin(mesh.GetPrim(), garment.skin, skeleton.joint_names)
        for place, body in zip(paths[2:], bodies):
            bind_skin(define_mesh(stage, place, body.mesh, units), body.skin, joints)
        save(stage.GetRootLayer(), path)


def write_garment(path: str | Path, mesh: Mesh) -> None:
    """Write a mesh to its own file, in metres and y up."""
    with replacing(path) as temporary:
        stage = new_stage(temporary, CORE_UNITS)
        prim = define_mesh(stage, _root_path(mesh.path), mesh, CORE_UNITS).GetPrim()
        Usd.ModelAPI(prim).SetKind(Kind.Tokens.component)
        UsdGeom.Gprim(prim).CreateDoubleSidedAttr(True)
        stage.SetDefaultPrim(prim)
        save(stage.GetRootLayer(), path)


def write_cache(
    path: str | Path,
    mesh: Mesh,
    points: Sequence[Floats],
    fps: float,
    start: int,
    record: GarmentRecord | None = None,
) -> None:
    """Write a mesh that has its points at each frame, in metres and y up, one time code per frame.

    Args:
        points: of each frame in the world [m], shape (V, 3).
        fps: frames per second [1/s].
        start: time code of the first frame.
        record: how the model of the mesh was made, where it is marked as a garment.
    """
    with replacing(path) as temporary:
        stage = new_stage(temporary, CORE_UNITS)
        prim = define_mesh(stage, _root_path(mesh.path), mesh, CORE_UNITS)
        stage.SetDefaultPrim(prim.GetPrim())
        if record is not None:
            prim.GetPrim().CreateAttribute(GARMENT, Sdf.ValueTypeNames.Bool).Set(True)
            apply_garment_api(prim.GetPrim(), record)
        stage.SetTimeCodesPerSecond(fps)
        stage.SetFramesPerSecond(fps)
        stage.SetStartTimeCode(start)
        stage.SetEndTimeCode(start + len(points) - 1)
        layer, places = stage.GetRootLayer(), prim.GetPointsAttr().GetPath()
        del stage, prim  # nobody has to hear of each sample
        for frame, each in enumerate(points):
            layer.SetTimeSample(places, start + frame, Vt.Vec3fArray.FromNumpy(np.asarray(each, dtype=np.float32)))
        save(layer, path)


def write_motion(path: str | Path, motion: Motion, skeleton: Skeleton, world: ShotWorld | None = None) -> None:
    """Write a motion as a SkelAnimation in its own file, one time code per frame, in metres and y up.

    Args:
        world: what else the file says.
    """
    with replacing(path) as temporary:
        stage = new_stage(temporary, CORE_UNITS)
        animation = UsdSkel.Animation.Define(stage, "/Animation")
        stage.SetDefaultPrim(animation.GetPrim())
        stage.SetTimeCodesPerSecond(motion.fps)
        stage.SetFramesPerSecond(motion.fps)
        stage.SetStartTimeCode(motion.start)
        stage.SetEndTimeCode(motion.start + motion.frame_count - 1)
        if world is not None:
            define_world(stage, world, motion.start)
        animation.CreateJointsAttr(Vt.TokenArray(skeleton.joint_names))
        animation.CreateScalesAttr(Vt.Vec3hArray(skeleton.joint_count, Gf.Vec3h(1)))
        rotations, translations = (
            attribute.GetPath() for attribute in (animation.CreateRotationsAttr(), animation.CreateTranslationsAttr())
        )
        layer = stage.GetRootLayer()
        del stage, animation  # nobody has to hear of each sample
        imaginary_first = np.roll(motion.rotations, -1, axis=-1).astype(np.float32)
        places = motion.translations.astype(np.float32)
        for frame, (turns, moves) in enumerate(zip(imaginary_first, places)):
            layer.SetTimeSample(rotations, motion.start + frame, Vt.QuatfArray.FromNumpy(turns))
            layer.SetTimeSample(translations, motion.start + frame, Vt.Vec3fArray.FromNumpy(moves))
        save(layer, path)


def write_direction(
    path: str | Path,
    garment: str,
    free: Floats,
    start: float,
    hold: int,
    parts: Mapping[str, Floats] | None = None,
    groups: Mapping[str, Ints] | None = None,
) -> None:
    """Add to a motion's file how a garment is directed over its frames (`reading.direction`).

    Args:
        garment: path of its prim.
        free: 0 where it is held to 1 where it moves freely, from the time code `start` on, shape (F,).
        hold: frames that each pose is held.
        parts: likewise of parts, shape (F,) each, by the name of the attribute.
        groups: vertices of those that are no proxies, shape (N,) each, by name.
    """
    stage = Usd.Stage.Open(str(path))
    prim = stage.OverridePrim(garment)
    if hold != 1:
        prim.CreateAttribute(HOLD, Sdf.ValueTypeNames.Int).Set(hold)
    for name, values in {FREE: free, **(parts or {})}.items():
        attribute = prim.CreateAttribute(name, Sdf.ValueTypeNames.Float)
        for frame, value in enumerate(values.tolist()):
            attribute.Set(value, start + frame)
    for name, vertices in (groups or {}).items():
        subset = UsdGeom.Subset.Define(stage, f"{garment}/{name}")
        subset.CreateElementTypeAttr(UsdGeom.Tokens.point)
        subset.CreateIndicesAttr(Vt.IntArray(vertices.tolist()))
    stage.GetRootLayer().Save()


def _root_path(name: str) -> str:
    return "/" + prim_names([name])[0]
