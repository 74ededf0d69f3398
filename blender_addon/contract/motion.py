# SPDX-License-Identifier: GPL-3.0-or-later
"""A character's motion to a file of its own: a SkelAnimation, one sample for each frame."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from pxr import Gf, Usd, UsdGeom, UsdSkel, Vt

from .arrays import Joints, Motion, to_parents
from .names import joint_paths
from .write import matrices


def write_motion(path: Path, joints: Joints, motion: Motion) -> Iterator[float]:
    """Write a motion of the character's joints, yielding the part that is done; frames become time codes.

    Args:
        path: the file to make: .usdc, .usd or .usda.
        joints: without proxies.
    """
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, motion.meters_per_unit)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    stage.SetTimeCodesPerSecond(motion.fps)
    stage.SetFramesPerSecond(motion.fps)
    stage.SetStartTimeCode(motion.start)
    stage.SetEndTimeCode(motion.start + len(motion.worlds) - 1)
    animation = UsdSkel.Animation.Define(stage, "/Motion")
    stage.SetDefaultPrim(animation.GetPrim())
    animation.CreateJointsAttr(Vt.TokenArray(joint_paths(joints.names, joints.parents)))
    animation.CreateScalesAttr(Vt.Vec3hArray(len(joints.names), Gf.Vec3h(1)))
    for done, worlds in enumerate(motion.worlds):
        translations, rotations, _ = UsdSkel.DecomposeTransforms(matrices(to_parents(worlds, joints.parents)))
        animation.GetTranslationsAttr().Set(translations, motion.start + done)
        animation.GetRotationsAttr().Set(rotations, motion.start + done)
        yield done / len(motion.worlds)
    stage.GetRootLayer().Save()
