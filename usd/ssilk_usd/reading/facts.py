# SPDX-License-Identifier: Apache-2.0
"""Facts of files that assets do not hold: authored units, frame rate, sampled times, animated joints, provenance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from pxr import Usd, UsdGeom, UsdSkel

from ssilk_core.files import split_location
from ssilk_core.scene.assets import Floats, Ints, Motion, Skeleton

from ..opening.stage import StageLike, open_stage, stage_name
from ..units import StageUnits
from .skin import match_joints


@dataclass(frozen=True)
class StageFacts:
    """A stage's units, and which of them are authored."""

    path: str
    units: StageUnits
    meters_authored: bool
    axis_authored: bool


def stage_facts(source: StageLike) -> StageFacts:
    """Return the units of a stage and whether they are authored.

    Raises:
        SsilkError: not a readable stage, or impossible units.
    """
    stage = open_stage(source)
    return StageFacts(
        stage_name(stage),
        StageUnits.of(stage),
        UsdGeom.StageHasAuthoredMetersPerUnit(stage),
        stage.HasAuthoredMetadata(UsdGeom.Tokens.upAxis),
    )


def playback_rate(source: StageLike) -> float | None:
    """Return the frames per second of a stage that has a time range [1/s]; None for one that has none.

    Raises:
        SsilkError: not a readable stage.
    """
    stage = open_stage(source)
    return float(stage.GetFramesPerSecond()) if stage.HasAuthoredTimeCodeRange() else None


def animated(motion: Motion, skeleton: Skeleton) -> tuple[Ints, Floats]:
    """Return which joints of a skeleton a motion's SkelAnimation animates, and when it has samples [s].

    `motion` was read from a file that still exists; joints are indices (N,), times (S,).
    """
    file, path = split_location(motion.path)
    stage = open_stage(file)
    animation = stage.GetPrimAtPath(path or "/")
    joints = tuple(str(name) for name in UsdSkel.Animation(animation).GetJointsAttr().Get() or ())
    match = np.array(match_joints(skeleton.joint_names, joints))
    return np.flatnonzero(match >= 0), _sample_times(animation) / stage.GetTimeCodesPerSecond()


def _sample_times(animation: Usd.Prim) -> Floats:
    names = ("rotations", "translations")
    return np.unique(np.concatenate([animation.GetAttribute(name).GetTimeSamples() for name in names]))


def read_provenance(source: StageLike) -> dict[str, Any]:
    """Return the provenance that `write_shot` stored; empty for other files.

    Raises:
        SsilkError: not a readable stage.
    """
    stage = open_stage(source)  # the layer lives only as long as its stage
    return dict(stage.GetRootLayer().customLayerData.get("ssilk", {}))
