# SPDX-License-Identifier: Apache-2.0
"""Plain files of a garment mesh and of a motion, as artists and motion libraries hand them over."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pxr import Gf, Kind, Usd, UsdGeom, UsdSkel, Vt

from ssilk_core.assets import Mesh, Motion, Skeleton
from ssilk_core.files import replacing

from .author import define_mesh, prim_names
from .export import new_stage, save
from .units import StageUnits

CORE_UNITS = StageUnits(1.0, UsdGeom.Tokens.y)


def write_garment(path: str | Path, mesh: Mesh) -> None:
    """Write a mesh as a file of its own, in metres and y up."""
    with replacing(path) as temporary:
        stage = new_stage(temporary, CORE_UNITS)
        prim = define_mesh(stage, _root_path(mesh.path), mesh, CORE_UNITS).GetPrim()
        Usd.ModelAPI(prim).SetKind(Kind.Tokens.component)
        stage.SetDefaultPrim(prim)
        save(stage.GetRootLayer(), path)


def write_motion(path: str | Path, motion: Motion, skeleton: Skeleton) -> None:
    """Write a motion as a SkelAnimation of its own, one time code for each frame, in metres and y up."""
    with replacing(path) as temporary:
        stage = new_stage(temporary, CORE_UNITS)
        animation = UsdSkel.Animation.Define(stage, "/Animation")
        stage.SetDefaultPrim(animation.GetPrim())
        stage.SetTimeCodesPerSecond(motion.fps)
        stage.SetFramesPerSecond(motion.fps)
        stage.SetStartTimeCode(motion.start)
        stage.SetEndTimeCode(motion.start + motion.frame_count - 1)
        animation.CreateJointsAttr(Vt.TokenArray(skeleton.joint_names))
        animation.CreateScalesAttr(Vt.Vec3hArray(skeleton.joint_count, Gf.Vec3h(1)))
        rotations, translations = animation.CreateRotationsAttr(), animation.CreateTranslationsAttr()
        for frame in range(motion.frame_count):
            time = motion.start + frame
            imaginary_first = np.roll(motion.rotations[frame], -1, axis=1).astype(np.float32)
            rotations.Set(Vt.QuatfArray.FromNumpy(imaginary_first), time)
            translations.Set(Vt.Vec3fArray.FromNumpy(motion.translations[frame].astype(np.float32)), time)
        save(stage.GetRootLayer(), path)


def _root_path(name: str) -> str:
    return "/" + prim_names([name])[0]
