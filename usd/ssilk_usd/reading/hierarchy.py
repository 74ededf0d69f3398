# SPDX-License-Identifier: Apache-2.0
"""Joints of a motion whose hierarchy is another one than the skeleton's, brought to the skeleton's parents.

Motions may have a root above the hips that carries them, twist joints that the skeleton lacks, or no parents at all.
What counts is where joints are, not beneath which others.
"""

from __future__ import annotations

import numpy as np

from ssilk_core.scene.assets import Floats, Ints, Skeleton
from ssilk_core.scene.kinematics import invert_rigid, rigid, world_transforms

_SHORT = 1e-3  # [m] bones that tell nothing


def to_parents_of(
    skeleton: Skeleton, authored: Floats, names: tuple[str, ...], match: Ints, metres: float, *, alone: bool
) -> Floats:
    """Return the transforms of a motion's joints to the parents that they have in a skeleton, shape (F, J, 4, 4).

    Where the skeleton has the motion's parents, these are the motion's own, bit for bit. Joints of the skeleton that
    the motion lacks keep their rest pose, and the joints below them are where the motion has them; what the motion
    does not know the parents of at all stays as authored.

    Args:
        authored: joint to parent in the motion, in its own unit of length, rigid, shape (F, N, 4, 4).
        names: paths of the motion's joints, length N.
        match: index of each joint of the skeleton in the motion, or -1, where the result means nothing, shape (J,).
        metres: the motion's unit of length [m].
        alone: no skeleton says that what has no parents by its path has none. Names without paths may be short for
            joints with them, then; the lengths of bones tell.
    """
    found, above = authored[:, match], parents_by_path(names)
    moved = np.flatnonzero(match >= 0)
    nearest = np.array([_nearest(joint, skeleton, match) for joint in range(len(match))])
    known = np.where(nearest < 0, -1, match[nearest])
    skips = nearest != skeleton.parents
    odd = [each for each in moved if known[each] != above[match[each]] or (skips[each] and nearest[each] >= 0)]
    if not odd:
        return found
    world, kept = _world(authored, names, above), np.array(found)
    for joint in odd:
        found[:, joint] = world[:, match[joint]]
        if nearest[joint] >= 0:
            between = _at_rest(joint, int(nearest[joint]), skeleton, metres)
            found[:, joint] = invert_rigid(world[:, known[joint]] @ between) @ found[:, joint]
    short = [each for each in odd if above[match[each]] < 0 and nearest[each] == skeleton.parents[each] >= 0]
    if alone and short and _misses(kept, short, skeleton, metres) < _misses(found, short, skeleton, metres):
        found[:, short] = kept[:, short]
    return found


def _misses(local: Floats, joints: list[int], skeleton: Skeleton, metres: float) -> float:
    """Return by how much bones are longer or shorter than the skeleton's in a motion's first frame."""
    lengths = [np.linalg.norm(each[joints, :3, 3], axis=1) for each in (local[0] * metres, skeleton.rest_transforms)]
    moved, rest = (np.maximum(each, _SHORT) for each in lengths)
    return float(np.median(np.abs(np.log(moved / rest))))


def placed_at_rest(skeleton: Skeleton, root: int, placements: Floats, otherwise: Floats) -> Floats:
    """Return a root joint that a motion lacks where the motion's xforms carry its rest pose [m], shape (F, 4, 4).

    Args:
        placements: the motion's skeleton space to the core's world, similarities, shape (F, 4, 4).
        otherwise: the same of the character's own stage where no xform places its skeleton, shape (4, 4).
    """
    before = otherwise if skeleton.placement is None else skeleton.placement
    return _rigid(placements) @ invert_rigid(_rigid(before)) @ skeleton.rest_transforms[root]


def beneath_rest(skeleton: Skeleton, local: Floats, names: tuple[str, ...], match: Ints, placements: Floats) -> None:
    """Put joints below others that a motion lacks where the motion has them, if they are roots of it.

    A joint whose path names more joints than the motion has is relative to these, and stays as it is.

    Args:
        local: joint to parent [m], shape (F, J, 4, 4), with roots placed, and such joints in the motion's skeleton
            space; changed here.
        placements: the motion's skeleton space to the core's world, similarities, (4, 4) or (F, 4, 4).
    """
    for joint in np.flatnonzero((match >= 0) & (np.asarray(skeleton.parents) >= 0)).tolist():
        if _nearest(joint, skeleton, match) >= 0 or "/" in names[match[joint]]:
            continue
        chain, above = np.eye(4), int(skeleton.parents[joint])
        while above >= 0:
            chain, above = local[:, above] @ chain, int(skeleton.parents[above])
        local[:, joint] = invert_rigid(chain) @ _rigid(placements) @ local[:, joint]


def _rigid(similarity: Floats) -> Floats:
    scale = np.cbrt(np.linalg.det(similarity[..., :3, :3]))[..., None, None]
    return rigid(similarity[..., :3, :3] / scale, similarity[..., :3, 3])


def parents_by_path(names: tuple[str, ...]) -> Ints:
    """Return the nearest joint above each one by their paths, as UsdSkel has it, -1 for none, shape (N,)."""
    place = {name: index for index, name in enumerate(names)}
    found = np.full(len(names), -1)
    for index, name in enumerate(names):
        while "/" in name and found[index] < 0:
            name = name.rpartition("/")[0]
            found[index] = place.get(name, -1)
    return found


def _nearest(joint: int, skeleton: Skeleton, match: Ints) -> int:
    """Return the nearest joint above one that the motion has, or -1."""
    above = int(skeleton.parents[joint])
    while above >= 0 and match[above] < 0:
        above = int(skeleton.parents[above])
    return above


def _at_rest(joint: int, top: int, skeleton: Skeleton, metres: float) -> Floats:
    """Return how a joint's parent is placed at rest to a joint above it, in units of a motion, shape (4, 4)."""
    between, above = np.eye(4), int(skeleton.parents[joint])
    while above != top:
        between = skeleton.rest_transforms[above] @ between
        above = int(skeleton.parents[above])
    between[:3, 3] /= metres
    return between


def _world(authored: Floats, names: tuple[str, ...], parents: Ints) -> Floats:
    """Return joint to skeleton space, shape (F, N, 4, 4), of joints in any order."""
    order = np.argsort([name.count("/") for name in names], kind="stable")  # parents before children
    place = np.argsort(order)
    above = np.array([place[parents[each]] if parents[each] >= 0 else -1 for each in order])
    return world_transforms(authored[:, order], above)[:, place]
