# SPDX-License-Identifier: Apache-2.0
"""What USD plays of a stage: the animation of a skeleton, and the joints that it poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pxr import Usd, UsdSkel

from ssilk_core.scene.assets import Floats, Ints

from ..opening.stage import column_matrix, inherited, value
from .bindings import unapplied
from .hierarchy import parents_by_path
from .joint_scales import SCALE_TOLERANCE, total_scales, uniform_scales

SOURCE = "skel:animationSource"
NEEDED = ("translations", "rotations", "scales")  # without one of these UsdSkel poses no joint


@dataclass(frozen=True)
class AnimationSource:
    """What animates a skeleton, as UsdSkel resolves it.

    Attributes:
        prim: the SkelAnimation; None where USD plays the rest pose.
        off: why a source that is authored plays nothing; empty where one plays, or none is authored.
    """

    prim: Usd.Prim | None = None
    off: str = ""


def animation_source(skeleton: Usd.Prim) -> AnimationSource:
    """Return what animates a skeleton: the nearest source that is authored on it or above, if USD can play that.

    A source without targets blocks those above it, and one that is deactivated or gone leaves the rest pose.
    """
    source = inherited(skeleton, SOURCE)
    if not isinstance(source, Usd.Relationship):
        return AnimationSource()
    targets = source.GetForwardedTargets()
    if not targets:
        return AnimationSource(off=f"{source.GetPath()} is blocked")
    prim = skeleton.GetStage().GetPrimAtPath(targets[0])
    if not prim:
        return AnimationSource(off=f"{source.GetPath()} names {targets[0]}, which is gone or in what is off")
    if not prim.IsActive():
        return AnimationSource(off=f"{targets[0]} is deactivated")
    if not prim.IsA(UsdSkel.Animation):
        return AnimationSource(off=f"{targets[0]} is no SkelAnimation")
    if missing := unapplied(source.GetPrim(), SOURCE):
        return AnimationSource(off=missing)
    lacks = [name for name in NEEDED if not prim.GetAttribute(name).HasAuthoredValue()]
    if lacks and value(prim, "joints"):  # without joints it weighs blendshapes alone
        return AnimationSource(off=f"{targets[0]} has no {lacks[0]}")
    return AnimationSource(prim)


@dataclass(frozen=True, eq=False)
class PosedJoints:
    """The joints of a skeleton that an animation poses, as UsdSkel maps them: by their paths.

    Attributes:
        names: UsdSkel joint paths of the skeleton, length N.
        source: index of each joint in the animation, -1 where it stays at rest, shape (N,).
        rest: joint to parent at rest in stage units, but for its scale, shape (N, 4, 4).
        factors: by which each is scaled there, shape (N,).
    """

    names: tuple[str, ...]
    source: Ints
    rest: Floats
    factors: Floats


def posed_joints(animated: tuple[str, ...], skeleton: Usd.Prim) -> PosedJoints | None:
    """Return which joints of a skeleton an animation of the joints `animated` poses.

    None where that skeleton says no rest pose that joints can have, or one that is scaled otherwise than its bind
    pose, so that scales would move points.
    """
    names = tuple(str(name) for name in value(skeleton, "joints") or ())
    rest = column_matrix(value(skeleton, "restTransforms") or np.zeros((0, 4, 4)))
    if not names or rest.shape != (len(names), 4, 4):
        return None
    factors = uniform_scales(rest)
    if not np.isfinite(factors).all() or not factors.all():
        return None
    if (factors != 1).any():
        binds = column_matrix(value(skeleton, "bindTransforms") or np.zeros((0, 4, 4)))
        if len(binds) != len(names):
            return None
        moved = uniform_scales(binds) / total_scales(factors, parents_by_path(names))
        if not (np.abs(moved / moved[0] - 1) <= 2 * SCALE_TOLERANCE).all():  # NaN is refused, too
            return None
    rest[:, :3, :3] /= factors[:, None, None]
    among = {name: index for index, name in enumerate(animated)}
    return PosedJoints(names, np.array([among.get(name, -1) for name in names]), rest, factors)
