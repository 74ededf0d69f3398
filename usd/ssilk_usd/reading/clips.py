# SPDX-License-Identifier: Apache-2.0
"""Which axis and which unit a SkelAnimation is in that stands alone, without the character that it moves.

Exporters write axis and scale of a character into an Xform above its skeleton. Joints then are in skeleton space,
lying and in centimetres perhaps, and so are clips of them, whatever their own files say of axis and units. UsdSkel
shows them by the character's Xforms. Other exporters convert clips to what their files say. The bones tell the unit,
which tells the axis too. Where both have one unit, the character stands upright by one of both axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssilk_core.scene.assets import Floats, Ints, Skeleton
from ssilk_core.scene.kinematics import world_transforms

from ..units import StageUnits
from .spaces import joints_to_core, similarity_scale

LOOKED_AT = 32  # frames of a clip
SAME = 1e-3  # relative difference of scales, and of rotation matrices, that is rounding
UPRIGHT = 0.5  # by how much more upright a character is by its clip's axis, where that one counts
_SHORT = 1e-3  # [m] bones that tell no scale


def spread(codes: Floats, count: int) -> Floats:
    """Return at most `count` of some time codes, spread evenly."""
    return codes[np.unique(np.linspace(0, len(codes) - 1, min(len(codes), count)).round().astype(int))]


@dataclass(frozen=True)
class Posture:
    """How upright a character is on average by both axes that its clip may be in, from 1 as at rest to -1.

    Attributes:
        by_character, by_file: by the axis of the character's Xforms, and by that of the clip's file.
        is_of_file: whether the clip is read by the latter.
    """

    by_character: float
    by_file: float
    is_of_file: bool


@dataclass(frozen=True, eq=False)
class ClipSpace:
    """What space a clip is in.

    Attributes:
        placement: from it to the world [m], (4, 4), for root joints; None where the units of the clip's file do that.
        posture: what told the up axis; None where anything else did.
    """

    placement: Floats | None
    posture: Posture | None = None


def clip_space(local: Floats, match: Ints, units: StageUnits, skeleton: Skeleton, *, says_axis: bool) -> ClipSpace:
    """Return the space that a clip is in, which stands alone.

    Args:
        local: joint to parent in some frames of the clip, as authored, in the skeleton's order, (F, J, 4, 4).
        match: index of each joint in the clip, or -1 where `local` means nothing, shape (J,).
        units: those of the clip's file.
        skeleton: of a character whose Xforms place it.
        says_axis: whether the clip's file states its up axis.
    """
    assert skeleton.placement is not None
    above = skeleton.placement
    scale = similarity_scale(above)
    metres = _scale_of_bones(local, match, skeleton, (scale, units.meters_per_unit))
    turn, posture = above[:3, :3] / scale, None
    if abs(scale / units.meters_per_unit - 1) > SAME:  # the unit tells the space: a character may lie
        is_converted = metres == units.meters_per_unit
    elif np.abs(turn - units.rotation).max() < SAME or not says_axis:
        is_converted = False
    else:
        by_character, by_file = (
            _uprightness(local, match, each, metres, skeleton) for each in (turn, units.rotation)
        )
        is_converted = by_file > by_character + UPRIGHT
        if np.abs(turn[1] - units.rotation[1]).max() > SAME:  # they differ in what is up
            posture = Posture(by_character, by_file, is_converted)
    if is_converted:
        return ClipSpace(None, posture)
    placement = np.eye(4)
    placement[:3, :3] = turn * metres
    placement[:3, 3] = above[:3, 3]
    return ClipSpace(placement, posture)


def _scale_of_bones(local: Floats, match: Ints, skeleton: Skeleton, choice: tuple[float, float]) -> float:
    """Return the scale [m] by which the clip's bones are as long as the skeleton's, the last one where both are."""
    rest = np.linalg.norm(skeleton.rest_transforms[:, :3, 3], axis=-1)
    kept = (np.asarray(skeleton.parents) >= 0) & (match >= 0) & (rest > _SHORT)
    first, last = choice
    if abs(first / last - 1) < SAME or not kept.any():
        return last
    ratio = float(np.median(np.linalg.norm(local[0, kept, :3, 3], axis=-1) / rest[kept]))
    if not ratio > 0:
        return last
    return first if abs(np.log(ratio * first)) < abs(np.log(ratio * last)) else last


def _uprightness(local: Floats, match: Ints, turn: Floats, metres: float, skeleton: Skeleton) -> float:
    """Return how upright the character's hub is on average, as `Posture` has it."""
    placement = np.eye(4)
    placement[:3, :3] = turn * metres
    posed = joints_to_core(local, skeleton.parents, placement, StageUnits())
    posed[:, match < 0] = skeleton.rest_transforms[match < 0]
    hub, rest = (
        world_transforms(joints, skeleton.parents)[..., skeleton.hub, :3, :3]
        for joints in (posed, skeleton.rest_transforms)
    )
    return float((hub @ rest.T)[:, 1, 1].mean())
