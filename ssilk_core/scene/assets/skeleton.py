# SPDX-License-Identifier: Apache-2.0
"""Joints of a character."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...errors import fail
from .arrays import Floats, Ints, assign, frozen, need_finite

_STRAY = 0.05  # of all bodies that may be bound to joints above or beside the one that carries them
_STRAY_ABOVE = 0.002  # of all bodies that the joint which holds them together may move, and yet carry none
_BEGIN = 0.2  # of the mean distance of the body's joints, within which limbs begin at the joint that holds them
_WHOLE = 0.999  # of a body, and no more, that one joint may move where several do


@dataclass(frozen=True, eq=False)
class Skeleton:
    """Joints of a character, parents before children.

    Attributes:
        path: source of the skeleton, for messages.
        joint_names: UsdSkel joint paths ("Hips/Spine"), length J.
        parents: index of each joint's parent, -1 for roots, shape (J,).
        bind_transforms: joint to world at the bind pose, rigid, shape (J, 4, 4).
        rest_transforms: joint to parent at rest (world for roots), rigid, shape (J, 4, 4).
        hub: the joint that carries the body as a whole, whichever stand above it: air moves along with it, cuts are
            its jumps, and what is relative to the character is relative to it.
        placement: skeleton space in its stage's units to world [m], a similarity, shape (4, 4), where the xforms
            above the skeleton tilt or scale it; None elsewhere.
        seen: the joints that a network sees in place of these; None for these.
        scales: by which the space of each joint is scaled in its stage, shape (J,), at rest and in its motions: it
            moves no point, and is left out here; None where it is 1.
    """

    path: str
    joint_names: tuple[str, ...]
    parents: Ints
    bind_transforms: Floats
    rest_transforms: Floats
    hub: int = 0
    placement: Floats | None = None
    seen: SeenJoints | None = None
    scales: Floats | None = None

    def __post_init__(self) -> None:
        count = len(self.joint_names)
        if not count > 0:
            fail(self.path, "the skeleton has no joints", "at least one is needed")
        if len(set(self.joint_names)) != count:
            fail(self.path, "joint names repeat", "each joint needs its own name")
        assign(
            self,
            joint_names=tuple(self.joint_names),
            parents=frozen(self.parents, np.int32),
            bind_transforms=frozen(self.bind_transforms, np.float64),
            rest_transforms=frozen(self.rest_transforms, np.float64),
        )
        if self.placement is not None:
            assign(self, placement=frozen(self.placement, np.float64))
            if self.placement.shape != (4, 4):
                fail(self.path, f"a placement of shape {self.placement.shape}", "(4, 4) is needed")
            need_finite(self.placement, self.path, "placement")
        if self.scales is not None:
            assign(self, scales=frozen(self.scales, np.float64))
            if self.scales.shape != (count,) or not (np.isfinite(self.scales) & (self.scales != 0)).all():
                fail(self.path, f"scales {self.scales} for {count} joints", "one for each joint is needed, none is 0")
        if self.parents.shape != (count,):
            fail(self.path, f"{len(self.parents)} parents for {count} joints", "one parent for each joint is needed")
        bad = np.flatnonzero((self.parents >= np.arange(count)) | (self.parents < -1))
        if bad.size != 0:
            fail(
                self.path,
                f"joint '{self.joint_names[bad[0]] if bad.size else ''}' precedes its parent",
                "parents must come first, and a joint must not be its own ancestor",
                "reorder the joints",
            )
        if not 0 <= self.hub < count:
            fail(self.path, f"joint {self.hub} carries the body", f"joints are 0 to {count - 1}")
        check_rigid(self.bind_transforms, self.path, "bind transform", self.joint_names)
        check_rigid(self.rest_transforms, self.path, "rest transform", self.joint_names)

    @property
    def joint_count(self) -> int:
        return len(self.joint_names)

    @property
    def hub_path(self) -> tuple[int, ...]:
        """The joints above the hub, from the top, and the hub."""
        path = [self.hub]
        while (above := int(self.parents[path[0]])) >= 0:
            path.insert(0, above)
        return tuple(path)


@dataclass(frozen=True, eq=False)
class SeenJoints:
    """Joints of the character that a network was trained on, as another character carries them.

    Attributes:
        skeleton: those joints, bound at the proportions of the other character.
        carriers: the joint of the other character that carries each of them, shape (J,).
        offsets: where they are in the space of these, rigid, shape (J, 4, 4).
        turn: by which the other character's bind pose is turned from what its stage has, rigid, shape (4, 4).
    """

    skeleton: Skeleton
    carriers: Ints
    offsets: Floats
    turn: Floats

    def __post_init__(self) -> None:
        assign(self, carriers=frozen(self.carriers, np.int64), offsets=frozen(self.offsets, np.float64))
        assign(self, turn=frozen(self.turn, np.float64))

    def world(self, transforms: Floats) -> Floats:
        """Return joint-to-world transforms (F, J, 4, 4) from those of the other character (F, J', 4, 4)."""
        return transforms[:, self.carriers] @ self.offsets


def carrying_joint(moved: Sequence[Floats], parents: Ints, places: Floats) -> int:
    """Return the joint that carries the body, a hub: the lowest that all bodies hang from, but for `_STRAY` of them.

    Game skeletons have joints above the hips, which may stand still while the character runs, and joints beside the
    hips for what hands hold. Bodies that one joint moves as a whole, such as props and shadows, do not count beside
    others. Where limbs have roots of their own, as deforming bones of control rigs have, it is the root amid them,
    whether or not a joint that moves nothing itself, and may stand still, holds them together. Such a joint carries
    them where all begin at it, as at MakeHuman's root, and not on the floor beneath. Where bodies of their own, as
    horse and rider, hang from such a joint, it is the largest body's.

    Args:
        moved: `moved_by_joints` of each body.
        parents: as a skeleton has them, shape (J,).
        places: of the joints in the bind pose [m], shape (J, 3).
    """
    own, below = _hanging(moved, parents)
    if not own.sum() > 0:  # nor where it is no number, which others refuse
        return 0
    held = np.flatnonzero(below >= (1 - _STRAY) * own.sum())
    above = int(held[-1]) if len(held) else -1
    if above >= 0:
        bending = _bending(moved)
        if own[above] > _STRAY_ABOVE * own.sum():
            return above
        if len(bending) > 1:
            return carrying_joint([max(bending, key=np.sum)], parents, places)
    roots = np.flatnonzero((parents == above) & (below > 0))
    if above >= 0:
        ways = np.linalg.norm(places - places[above], axis=-1)
        if ways[roots].max() < _BEGIN * (ways @ own) / own.sum():
            return above
    away = np.linalg.norm(places[roots, None] - places, axis=-1) @ own
    return int(roots[away.argmin()])


def is_carried_by(moved: Sequence[Floats], parents: Ints, joint: int) -> bool:
    """Return whether all bodies hang from a joint, as `carrying_joint` counts them."""
    own, below = _hanging(moved, parents)
    return bool(below[joint] >= (1 - _STRAY) * own.sum())


def _bending(moved: Sequence[Floats]) -> list[Floats]:
    """Return what joints move of those bodies that no joint moves as a whole."""
    return [each for each in moved if each.max() < _WHOLE * each.sum()]


def _hanging(moved: Sequence[Floats], parents: Ints) -> tuple[Floats, Floats]:
    """Return how much of the bodies each joint moves, and with all joints below it, shapes (J,)."""
    own = np.sum([np.zeros(len(parents)), *(_bending(moved) or moved)], axis=0)
    below = own.copy()
    for joint in range(len(parents) - 1, -1, -1):
        if parents[joint] >= 0:
            below[parents[joint]] += below[joint]
    return own, below


def moved_by_joints(points: Floats, weights: Floats) -> Floats:
    """Return how much of a body each joint moves, shape (J,): its mean weight, times the square of the body's size.

    Args:
        points: of the body, shape (V, 3).
        weights: of the joints at the points, shape (V, J).
    """
    size = np.ptp(points, axis=0)
    return weights.mean(axis=0) * float(size @ size)


def check_rigid(transforms: Floats, where: str, what: str, names: tuple[str, ...]) -> None:
    """Raise `SsilkError` unless every (4, 4) matrix is a proper rotation and a translation (to 1e-3)."""
    if transforms.shape != (len(names), 4, 4):
        fail(
            where,
            f"{what}s of shape {transforms.shape}",
            f"({len(names)}, 4, 4) is needed, one matrix for each joint",
        )
    need_finite(transforms, where, f"{what}s")
    linear = transforms[:, :3, :3]
    error = np.abs(linear @ linear.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    bad = np.flatnonzero((error > 1e-3) | (np.linalg.det(linear) < 0))
    if bad.size != 0:
        fail(
            where,
            f"the {what} of joint '{names[bad[0]] if bad.size else ''}' scales, shears or mirrors",
            "joints may only rotate and move",
            "apply the scale to the rig and export again",
        )
