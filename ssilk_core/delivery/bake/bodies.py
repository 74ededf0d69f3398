# SPDX-License-Identifier: Apache-2.0
"""A model on the character of a stage, which need be no body that the model was trained on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import PurePath
from typing import TYPE_CHECKING

import numpy as np

from ...errors import SsilkError, fail
from ...events import Event, Message
from ...files import split_location
from ...network.checkpoint import ModelFile
from ...scene.assets import Character, Motion, Scene, Skeleton
from ...scene.family import BodyFamily, BodyPlace, has_bones, names_of
from ...scene.posed_alike import turned
from .character import BIND_TOLERANCE, TODO, in_order_of, other_shapes
from .onto import put_onto

if TYPE_CHECKING:
    from pxr import Usd

TRAINED, FARTHEST = 0.1, 0.5  # how far beyond the members bodies were trained on, and may be
NEAR, UNLIKE = 0.005, 0.03  # [m] from the family's space, from which on it is told, and refused
SAME = 1e-4  # [m] on average, within which a body is a member
DIGITS = 7  # of what tells bodies apart
BETTER = f"{TODO}, or with it among --family"


@dataclass(frozen=True, eq=False)
class WornModel:
    """A model on the character of a stage.

    Attributes:
        file: as a model for that body.
        scene: its garment there.
        told: what there is to say of the body.
        body: what tells it from other bodies of the model's family: its coordinates, then where its joints are
            bound and how far off the family its points are [m]; on another skeleton where the joints are bound that
            the network sees [m]; None for the body that the model is of.
    """

    file: ModelFile
    scene: Scene
    told: tuple[Event, ...] = ()
    body: tuple[float, ...] | None = None

    @property
    def member(self) -> tuple[float, ...] | None:
        """`body` of a body of the model's family; None for the first of these, and on another skeleton."""
        return None if self.scene.character.skeleton.seen else self.body


def worn(file: ModelFile, stage: Usd.Stage, root: str | None) -> WornModel:
    """Put a model on the character of a stage, as `worn_by`; one with another skeleton as `onto.put_onto`.

    Raises:
        SsilkError: the stage's character is none that the model dresses, or it cannot be read.
    """
    from ssilk_usd.reading.character import has_meshes, read_character

    character = read_character(stage, root=root, garment=None)
    own = file.scene.character.skeleton
    if own.seen is not None:  # it was put on this character already
        again = in_order_of(own, turned(character, own.seen.turn))
        return WornModel(file, replace(file.scene, character=again))
    if not _is_own(file, character) and (put := put_onto(file, stage, character)):
        return WornModel(put.file, put.file.scene, put.told, put.identity)
    names = file.bodies.family.bodies.meshes if file.bodies else ()
    known = character
    if not names_of(character).issuperset(names) and has_meshes(stage, root, names):
        # Meshes that a joint carries are read where they are named alone, as `--body` may have named them.
        known = read_character(stage, root=root, bodies=names)
    return worn_by(file, character, known)


def _is_own(file: ModelFile, character: Character) -> bool:
    """Return whether a character is the one that a model was trained on, or first of its family."""
    try:
        in_order_of(file.scene.character.skeleton, character)
    except SsilkError:
        return False
    return True


def worn_by(file: ModelFile, character: Character, known: Character) -> WornModel:
    """Put a model on a character.

    A model for one body fits that body. One of a family fits any body of it. A body beyond `FARTHEST`, or one that
    the members do not add up to, is refused. Up to there networks see bodies as they are, those beyond `TRAINED` too:
    where what they saw ended there, the cloth lay on another body (docs/training.md).

    Args:
        known: the same character, with those meshes at least that the model's family knows.

    Raises:
        SsilkError: the model does not dress it.
    """
    base = file.scene.character.skeleton
    if file.bodies is None:
        told = other_shapes(base, character)
        return WornModel(file, replace(file.scene, character=in_order_of(base, character)), told)
    own, bodies = in_order_of(base, character, moved=True), file.bodies.family.bodies
    place = bodies.place_of(own if known is character else in_order_of(base, known, moved=True))
    _need_like(bodies, place, character.path)
    away = np.linalg.norm(own.skeleton.bind_transforms[:, :3, 3] - base.bind_transforms[:, :3, 3], axis=1)
    if not place.coordinates.any() and away.max() < BIND_TOLERANCE:
        one = file.on_body(place.coordinates)
        return WornModel(one, replace(one.scene, character=in_order_of(base, character)), _unlike(place, own))
    one = file.on_body(place.coordinates)
    bare = replace(own, bodies=(), stand_ins=())  # as model files have it
    one = replace(one, scene=replace(one.scene, character=bare))
    told = tuple(_told(bodies, place, own))
    return WornModel(one, replace(one.scene, character=own), told, _identity(place, own))


def other_bones(path: str, motion: Motion, character: Character, first: Skeleton | None) -> tuple[Event, ...]:
    """Return a warning where a motion has the bones of the first body of a family, and not those of its character.

    Args:
        path: of the motion.
        first: the skeleton of that body; None where the character is the first.
    """
    if first is None or has_bones(motion, character.skeleton) or not has_bones(motion, first):
        return ()
    found = "its joints are as far apart as those of the first body of the model's family"
    text = f"{path}: {found}, and {character.path} is drawn between these; retarget it to the bones of this body"
    return (Message(text, "warning"),)


def _need_like(bodies: BodyFamily, place: BodyPlace, path: str) -> None:
    off = max(place.joints_off, place.points_off)
    if off > UNLIKE:
        found = f"its shape is {1000 * off:.0f} mm from all that the model's family of bodies adds up to"
        fail(path, found, f"{1000 * UNLIKE:.0f} mm are allowed", BETTER)
    if place.beyond > FARTHEST:
        found = f"its body is {place.beyond:.0%} beyond the bodies that the model was trained for"
        found = f"{found}, {_nearest(bodies, place)}"
        fail(path, found, f"{FARTHEST:.0%} are allowed", BETTER)


def _identity(place: BodyPlace, own: Character) -> tuple[float, ...]:
    joints = own.skeleton.bind_transforms[:, :3, 3].reshape(-1)
    numbers = np.concatenate([place.coordinates, joints, [place.points_off]])
    return tuple((np.round(numbers, DIGITS) + 0.0).tolist())


def _nearest(bodies: BodyFamily, place: BodyPlace) -> str:
    """Say which body of the training is nearest, and by how much."""
    name, away = bodies.nearest_member(place.coordinates)
    file, prim = split_location(name)
    name = f"{PurePath(file).name}:{prim}" if prim else PurePath(file).name
    if away < SAME:
        return f"that of {name}"
    return f"nearest to {name}, whose skin is {1000 * away:.{0 if away >= 0.01 else 1}f} mm away on average"


def _told(bodies: BodyFamily, place: BodyPlace, character: Character) -> list[Event]:
    path = character.path
    text = f"{path}: a body of the model's family, {_nearest(bodies, place)}"
    told: list[Event] = [Message(text), *_unlike(place, character)]
    if place.beyond > TRAINED:
        text = f"it is {place.beyond:.0%} beyond the bodies of the training, which went to {TRAINED:.0%}"
        told.append(Message(f"{path}: {text}; its cloth may fit less well", "warning"))
    return told


def _unlike(place: BodyPlace, character: Character) -> tuple[Event, ...]:
    off = max(place.joints_off, place.points_off)
    if off <= NEAR:
        return ()
    text = f"its shape is {1000 * off:.0f} mm from the family's; the garment lies as on the nearest of its bodies"
    return (Message(f"{character.path}: {text}", "warning"),)
