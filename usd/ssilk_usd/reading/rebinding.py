# SPDX-License-Identifier: Apache-2.0
"""Garments that are bound to another Skeleton than the character's, brought into the character's bind pose.

A garment may come with a Skeleton prim of its own, which has joints of the same names, and a bind pose, a rest pose
and a place of its own. UsdSkel shows it by those. Joint by joint, the garment goes to where it is seen beside the
character, and from there back into the character's bind pose.
"""

from __future__ import annotations

import numpy as np
from pxr import Usd, UsdSkel

from ssilk_core.errors import fail
from ssilk_core.scene.assets import Floats, Skeleton
from ssilk_core.scene.kinematics import world_transforms

from ..opening.stage import EARLIEST, PRIMS, column_matrix, location, value
from ..opening.times import change_times
from ..units import scaling
from .animation import NEEDED, animation_source
from .clips import spread
from .skeleton import skeleton_at, skeletons
from .skin import AuthoredInfluences, match_joints
from .spaces import SkelSource

SAME = 1e-5  # [m], and of rotation matrices: two bind poses that differ by less are one, rounded
COMPARED = 200  # time codes at which two animations are compared, at most
ONE_MOTION = 1e-3  # [m], and of rotation matrices: how far joints of two Skeletons may part while they are animated
SAME_PLACE = 1e-3  # of the size of the skeleton, within which joints stand where those of another do


def character_source(stage: Usd.Stage, skeleton: Skeleton) -> SkelSource | None:
    """Return the Skeleton of a stage that a character's skeleton was read from; None where it is not in it."""
    found = (pair for pair in skeletons(stage) if location(pair[1]) == skeleton.path)
    pair = next(found, None)
    return skeleton_at(*pair) if pair else None


def joint_moves(own: SkelSource, skeleton: Skeleton) -> Floats | None:
    """Return what moves what each joint carries from its bind pose to the character's [m], shape (N, 4, 4).

    In one stage with the character, both are compared as USD shows them: animated where both are, else at rest. A
    garment in its own file was fitted to its own bind pose. Joints that the character lacks move as those above them.

    Returns:
        Rigid transforms in the core's bind space, for the joints of `own`; None where nothing moves.
    """
    if location(own.prim) == skeleton.path:
        return None
    match = np.array(match_joints(own.joints, skeleton.joint_names))
    theirs, binds = own.binds_to_core(own.bind), skeleton.bind_transforms
    character = character_source(own.stage, skeleton)
    if character is None:
        places, wanted = theirs[match >= 0, :3, 3], binds[match[match >= 0], :3, 3]
        if len(places) and np.abs(places - wanted).max() <= SAME_PLACE * max(np.ptp(wanted, axis=0).max(), SAME):
            return None  # one pose: programs give the same joints other axes
        to_character = binds[match] @ np.linalg.inv(theirs)
    else:
        animated = all(animation_source(source.prim).prim for source in (own, character))
        queries = (_query(character), _query(own)) if animated else (None, None)
        shown = _shown(character, queries[0])[character.character_joints] @ np.linalg.inv(binds)
        to_character = np.linalg.inv(shown)[match] @ _shown(own, queries[1]) @ np.linalg.inv(theirs)
    for joint in np.flatnonzero(match < 0):
        above = own.parents[joint]
        to_character[joint] = to_character[above] if above >= 0 else np.eye(4)
    return to_character if np.abs(to_character - np.eye(4)).max() > SAME else None


def need_one_motion(own: SkelSource, skeleton: Skeleton, used: list[str]) -> None:
    """Check that an animation of a garment's own Skeleton, not the character's, moves it as the character's does.

    Args:
        used: joints of `own` that carry the garment.

    Raises:
        SsilkError: a joint moves away from where the character has it.
    """
    character, animation = character_source(own.stage, skeleton), animation_source(own.prim).prim
    if character is None or animation is None:
        return
    theirs = animation_source(character.prim).prim
    # Without joints it weighs blendshapes alone. A character that stands still here is moved from elsewhere.
    if theirs is None or animation == theirs or not value(animation, "joints"):
        return
    times = change_times(source.GetAttribute(name) for source in (animation, theirs) for name in NEEDED)
    match = np.array(match_joints(own.joints, skeleton.joint_names))
    mine = [joint for joint, name in enumerate(own.joints) if name in used and match[joint] >= 0]
    queries, first = (_query(character), _query(own)), None
    for code in map(Usd.TimeCode, spread(np.array(times), COMPARED).tolist()):
        placed = _shown(character, queries[0], code)[character.character_joints][match[mine]]
        shown = _shown(own, queries[1], code)[mine]
        first = np.linalg.pinv(placed) @ shown if first is None else first  # a joint may be scaled to nothing
        off = np.abs(placed @ first - shown).max(axis=(1, 2))
        if off.size and not off.max() <= ONE_MOTION:  # what is not a number is off, too
            fail(
                location(own.prim),
                f"its animation {animation.GetPath()} moves {own.joints[mine[int(off.argmax())]]} otherwise than the "
                f"character's Skeleton at time code {code.GetValue():g}",
                "a garment moves with the joints of its character",
                f"bind it to the animation of {skeleton.path}, or the garment to that Skeleton",
            )


def common_move(moves: Floats) -> Floats | None:
    """Return the one transform that all of some are (4, 4), up to rounding; None where they differ."""
    return moves[0] if np.abs(moves - moves[0]).max() <= SAME else None


def blended_moves(moves: Floats, influences: AuthoredInfluences) -> Floats:
    """Return the linear blend of joints' transforms for each point, shape (V, 4, 4)."""
    total = influences.weights.sum(axis=1, keepdims=True)
    weights = influences.weights / np.where(total > 0, total, 1)
    blended = np.einsum("vi,viab->vab", weights, moves[influences.indices])
    blended[total[:, 0] <= 0] = np.eye(4)
    return blended


def used_moves(moves: Floats, influences: AuthoredInfluences, joints: tuple[str, ...]) -> tuple[Floats, Floats]:
    """Return joints' transforms in the joint order of influences, shape (M, 4, 4), and of those in use alone."""
    ordered = np.concatenate([moves, np.eye(4)[None]])[match_joints(influences.joints, joints)]
    return ordered, ordered[np.unique(influences.indices[influences.weights != 0])]


def _query(source: SkelSource) -> UsdSkel.SkeletonQuery:
    """Return what animates a skeleton as USD shows it."""
    cache = UsdSkel.Cache()
    cache.Populate(UsdSkel.Root(source.root), PRIMS)
    return cache.GetSkelQuery(UsdSkel.Skeleton(source.prim))


def _shown(source: SkelSource, query: UsdSkel.SkeletonQuery | None, time: Usd.TimeCode = EARLIEST) -> Floats:
    """Return joint to core world [m] as USD shows a skeleton, placed as at first, rigid, shape (N, 4, 4).

    Without a query it is at rest.
    """
    posed = world_transforms(source.rest, source.parents)
    if query:
        found = query.ComputeJointSkelTransforms(time)
        posed = source.unscaled(column_matrix(found)) if found else posed
    return source.units.matrix @ source.placement @ posed @ scaling(1 / source.joint_scale)
