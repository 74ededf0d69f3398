# SPDX-License-Identifier: Apache-2.0
"""What there is to say of a map of joints between two characters."""

from __future__ import annotations

import numpy as np

from ...errors import SsilkError
from ...events import format_count
from ...scene.assets import Character, Garment, Ints, Skeleton
from ...scene.joint_map import OTHER_SIZE, JointMap, short_names, size_ratio, weights_left
from ...scene.posed_alike import TURNED, alike
from ..preflight.finding import Finding, Findings, format_joints, index_tuple

LISTED = 6


def joint_findings(names: JointMap, own: Character, other: Character, garment: Garment) -> Findings:
    """Yield what there is to say of a map; an error where it is not sound."""
    mine, its = own.skeleton, other.skeleton
    try:
        images = names.images(mine, its)
        posed = alike(mine, its, images)
    except SsilkError as error:
        yield Finding(
            severity="error", code="joint-map", prim=names.path, found=error.found or str(error),
            why=error.allowed, fix=error.todo,
        )  # fmt: skip
        return
    left = np.flatnonzero(images < 0)
    ways = [names.notes.get(name, "").partition(",")[0] for name in short_names(mine)]
    counted = {way: ways.count(way) for way in ("by name", "by name and place", "by place") if way in ways}
    how = f" ({', '.join(f'{count} {way}' for way, count in counted.items())})" if counted else ""
    none = f"; none stands for {format_joints(mine, left, LISTED)}" if len(left) else ""
    yield Finding(
        severity="info", code="joint-map", prim=names.path, count=mine.joint_count - len(left), elements="joints",
        indices=index_tuple(np.flatnonzero(images >= 0)),
        found=f"joints of {other.path} stand for {mine.joint_count - len(left)} of {mine.joint_count}{how}{none}",
        why="a joint that none stands for moves with the one above it",
        fix="edit the map where it is wrong, and give it to 'ssilk rig --onto'",
    )  # fmt: skip
    yield from _on_weights(mine, images, garment)
    turned = np.flatnonzero(posed.turned > TURNED)
    turned = turned[np.isin(turned, images)]
    if len(turned):
        yield Finding(
            severity="info", code="other-bind-pose", prim=other.path, count=len(turned), elements="joints",
            indices=index_tuple(turned),
            found=f"{format_count(len(turned), 'joints')} are bound up to {posed.turned[turned].max():.0f} degrees "
                  f"from where {own.path} has them: {format_joints(its, turned, LISTED)}",
            why="the garment is put on in the pose in which it was made, and brought into this one",
        )  # fmt: skip
    ratio = size_ratio(mine, its, images)
    if abs(ratio - 1) > OTHER_SIZE:
        yield Finding(
            severity="warning", code="other-size", prim=other.path,
            found=f"it is {abs(ratio - 1):.0%} {'taller' if ratio > 1 else 'smaller'} than {own.path}",
            why="a model moves the garment as on the body that it was trained for",
            fix="train it on this character",
        )  # fmt: skip


def _on_weights(skeleton: Skeleton, images: Ints, garment: Garment) -> Findings:
    """Yield a warning for joints that move much of the garment and have no counterpart."""
    if garment.skin is None:
        return
    left = weights_left(garment.skin, skeleton, images)
    if left:
        joints = [joint for joint, _ in left]
        yield Finding(
            severity="warning", code="joints-left", prim=garment.mesh.path, count=len(left), elements="joints",
            indices=index_tuple(joints),
            found=f"{sum(share for _, share in left):.0%} of its weight is on joints that none stands for: "
                  f"{format_joints(skeleton, joints, LISTED)}",
            why="what they moved follows the joints above them",
            fix="name joints for them in the map, if the other character has some",
        )  # fmt: skip
