# SPDX-License-Identifier: Apache-2.0
"""The skeleton that a garment was trained on, in the order in which a stage has its joints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...errors import fail
from ...events import Event, Message
from ...files import split_body, split_location
from ...scene.assets import Character, Ints, Skeleton, SkinWeights
from ...scene.family import with_joints

BIND_TOLERANCE = 1e-3  # [m] between positions, and between the entries of rotation matrices
ALLOWED, TODO = "a model bakes on the character it was trained with", "train on this character"
BOTH = f"{TODO}, or on both bodies with --family"
ONTO = f"{TODO}, or put the garment onto its joints by 'ssilk rig --onto' with a map of joints"
OTHER_SHAPES = "train with them by --family, or take the body of the training"


def in_order_of(trained: Skeleton, character: Character, *, moved: bool = False) -> Character:
    """Return a character with the skeleton of a model, whose joints are its own in another order perhaps.

    Programs list joints in the order that they like: UsdSkel only wants parents before their children.

    Args:
        moved: whether joints may be bound elsewhere, at the same rotations, and stay there.

    Raises:
        SsilkError: the character has other joints, or other bind transforms.
    """
    order = _places(character.skeleton, trained)
    if moved:
        trained = with_joints(trained, character.skeleton.bind_transforms[order, :3, 3])
    _need_same_binds(character.skeleton, trained, order)
    joints = np.argsort(order)  # of the model, for each joint of the character
    bodies, stand_ins = (
        tuple(
            replace(body, skin=SkinWeights(body.skin.path, joints[body.skin.indices], body.skin.weights))
            for body in some
        )
        for some in (character.bodies, character.stand_ins)
    )
    own = character.skeleton
    scales = None if own.scales is None else own.scales[order]
    skeleton = replace(trained, placement=own.placement, scales=scales)
    return replace(character, skeleton=skeleton, bodies=bodies, stand_ins=stand_ins)


def other_shapes(trained: Skeleton, character: Character) -> tuple[Event, ...]:
    """Return a warning where a body by shapes has the joints of a model for one body, which was trained on others."""
    own, there = (split_body(split_location(path)[0])[1] for path in (trained.path, character.path))
    if own == there or not there:
        return ()
    text = "its shapes leave the joints in place, and the model was trained without them: it does not see them"
    return (Message(f"{character.path}: {text}; {OTHER_SHAPES}", "warning"),)


def _places(found: Skeleton, trained: Skeleton) -> Ints:
    """Return where each joint of the model stands in a skeleton, by its path or unique name, shape (J,)."""
    from ssilk_usd.reading.skin import match_joints

    order = np.array(match_joints(trained.joint_names, found.joint_names))
    missing = [name for name, place in zip(trained.joint_names, order) if place < 0]
    if missing:
        fail(found.path, f"{len(missing)} of the model's joints are missing ({_some(missing)})", ALLOWED, ONTO)
    more = [name for place, name in enumerate(found.joint_names) if place not in order]
    if more:
        fail(found.path, f"{len(more)} of its joints are not the model's ({_some(more)})", ALLOWED, TODO)
    above = np.where(found.parents[order] < 0, -1, np.argsort(order)[found.parents[order]])
    hung = np.flatnonzero(above != trained.parents)
    if len(hung):
        fail(found.path, f"joint '{found.joint_names[order[hung[0]]]}' has another parent", ALLOWED, TODO)
    return order


def _some(names: list[str]) -> str:
    return ", ".join(names[:3])


def _need_same_binds(found: Skeleton, trained: Skeleton, order: Ints) -> None:
    """Raise `SsilkError` unless joints are bound where the model has them."""
    names = [found.joint_names[place] for place in order]
    difference = found.bind_transforms[order] - trained.bind_transforms
    away = np.linalg.norm(difference[:, :3, 3], axis=1)
    joint = int(away.argmax())
    if not away[joint] < BIND_TOLERANCE:
        fail(
            found.path,
            f"joint '{names[joint]}' is bound {away[joint]:.3g} m from where the model has it",
            ALLOWED,
            BOTH,
        )
    turned = np.abs(difference[:, :3, :3]).max(axis=(1, 2))
    joint = int(turned.argmax())
    if not turned[joint] < BIND_TOLERANCE:
        fail(
            found.path,
            f"joint '{names[joint]}' is bound at another rotation than the model has it",
            ALLOWED,
            ONTO,
        )
