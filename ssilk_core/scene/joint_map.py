# SPDX-License-Identifier: Apache-2.0
"""Which joints of another character stand for those of the one that a garment was made on, as a text file says.

The file is TOML with one table, `joints`: on each line a joint of the garment's character, and the joint of the other
one that stands for it, or "" for none. A joint that none stands for moves with the nearest one above it that has one.
Joints are named by the last part of their paths, or by whole paths where two end alike.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..errors import fail, fail_unknown
from ..files import replacing
from .assets import Floats, Ints, Skeleton, SkinWeights

TABLE = "joints"
BESIDE = 0.04  # of the height, by which a joint beside the hub has a side
MIDDLE, OUT = 0.02, 0.15  # of the height: in the middle, and beyond what may be so in another rig
FACING = 20.0  # [degrees] between headings, from which on characters face another way in their bind poses
NAMED_SIDES = tuple(
    (
        side,
        re.compile(
            rf"(?i:{side}|(?:^|[^a-z]){side[0]}(?:[^a-z]|$))|^[{side[0]}{side[0].upper()}](?=[A-Z][a-z])|[a-z]{side[0].upper()}$"
        ),
    )
    for side in ("left", "right")
)
LEFT = 0.02  # of a garment's weight on a joint that none stands for, from which on it is told
OTHER_SIZE = 0.15  # of the size, by which characters differ, from which on it is told as a warning
AWAY = 0.03  # of the height, from a joint to the one that it moves with
LISTED = 3
ALLOWED = "a line holds a joint of the garment's character, and the joint of the other one that stands for it"


@dataclass(frozen=True, eq=False)
class JointMap:
    """Joints of another character that stand for a garment's own.

    Attributes:
        path: where it was read from, for messages.
        names: the other character's joint for each of the garment's, "" for none; names as in the file.
        notes: how each was found, for the file.
    """

    path: str
    names: Mapping[str, str]
    notes: Mapping[str, str] = field(default_factory=dict)

    def images(self, own: Skeleton, other: Skeleton) -> Ints:
        """Return the index of the joint of `other` that stands for each joint of `own`, or -1, shape (J,).

        Raises:
            SsilkError: the map is not sound: a joint is unknown or stands for two, sides or hierarchy are not kept,
                or none stands for the joint that carries the body.
        """
        places, others = _places(own), _places(other)
        found = np.full(own.joint_count, -1)
        for name, image in self.names.items():
            if name not in places:
                fail_unknown(self.path, f"{own.path} has no joint '{name}'", name, _names(own))
            if image and image not in others:
                fail_unknown(f"{self.path}: '{name}'", f"{other.path} has no joint '{image}'", image, _names(other))
            if image:
                found[places[name]] = others[image]
        self._need_once(own, other, found)
        self._need_hub(own, found)
        self._need_order(own, other, found)
        self._need_sides(own, other, found)
        return found

    def _need_once(self, own: Skeleton, other: Skeleton, images: Ints) -> None:
        repeated = [joint for joint, count in Counter(images[images >= 0].tolist()).items() if count > 1]
        if repeated:
            first, second = (leaf(own, joint) for joint in np.flatnonzero(images == repeated[0])[:2])
            found = f"'{leaf(other, repeated[0])}' stands for both '{first}' and '{second}'"
            fail(self.path, found, "a joint stands for one joint at most", 'write "" for one of them')

    def _need_hub(self, own: Skeleton, images: Ints) -> None:
        if images[own.hub] < 0:
            found = f"no joint stands for '{leaf(own, own.hub)}', which carries the body"
            fail(self.path, found, "the other character has one too", "name its hips or pelvis")

    def _need_order(self, own: Skeleton, other: Skeleton, images: Ints) -> None:
        """Raise `SsilkError` where a joint's image hangs from the image of no joint that it hangs from itself."""
        stands_for = {int(image): joint for joint, image in enumerate(images) if image >= 0}
        for joint, image in enumerate(images.tolist()):
            above = int(other.parents[image]) if image >= 0 else -1
            while above >= 0 and above not in stands_for:
                above = int(other.parents[above])
            if above >= 0 and stands_for[above] not in ancestors(own, joint):
                name, its = leaf(own, joint), leaf(own, stands_for[above])
                found = (
                    f"'{leaf(other, image)}' for '{name}' hangs from '{leaf(other, above)}' for '{its}', "
                    f"and '{name}' does not hang from '{its}'"
                )
                fail(self.path, found, "joints hang from each other on both characters alike", "correct one of them")

    def _need_sides(self, own: Skeleton, other: Skeleton, images: Ints) -> None:
        mapped = np.flatnonzero(images >= 0)
        there = _about_hub(other, images[own.hub]) @ heading(own, other, images).T
        here = _about_hub(own, own.hub)
        across = np.zeros(3)  # from side to side, which is where limbs are apart most
        across[[0, 2]] = np.linalg.svd(here[mapped][:, [0, 2]])[2][0]
        for joint in mapped.tolist():
            name, image = leaf(own, joint), leaf(other, int(images[joint]))
            sides = named_side(name), named_side(image)
            if None not in sides and sides[0] != sides[1]:
                found = f"'{image}' on the {sides[1]} stands for '{name}' on the {sides[0]}"
                fail(self.path, found, "left stands for left", "correct it")
            a, b = (float(each @ across) for each in (here[joint], there[images[joint]]))
            if min(abs(a), abs(b)) > BESIDE and a * b < 0:
                found = f"'{image}' for '{name}' is on the other side of the body"
                fail(self.path, found, "left stands for left", "correct it")
            if min(abs(a), abs(b)) < MIDDLE and max(abs(a), abs(b)) > OUT:
                found = f"of '{image}' and '{name}' one is in the middle of the body and one far beside it"
                fail(self.path, found, "joints stand for those of the same limb", "correct it")


def read_joint_map(path: str | Path) -> JointMap:
    """Read a map of joints.

    Raises:
        SsilkError: there is no such file, or it holds something else.
    """
    path = Path(path)
    if not path.is_file():
        fail(str(path), "there is no such file", "a map of joints is needed", "'ssilk inspect --onto' proposes one")
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        fail(str(path), f"not a TOML file ({error})", f"a map of joints has one table, [{TABLE}]")
    names = tables.get(TABLE)
    if list(tables) != [TABLE] or not isinstance(names, dict):
        fail(str(path), f"tables {', '.join(tables) or 'none'}", f"a map of joints has one table, [{TABLE}]")
    for name, image in names.items():
        if not isinstance(image, str):
            fail(f"{path}: '{name}'", f"{str(image)[:40]} stands for it", ALLOWED, 'write "" for none')
    return JointMap(str(path), names)


def write_joint_map(path: str | Path, found: JointMap, about: str) -> None:
    """Write a map of joints; `about` is what its first lines say.

    Raises:
        SsilkError: the file cannot be written.
    """
    pairs = [(_key(name), json.dumps(image, ensure_ascii=False)) for name, image in found.names.items()]
    width = max(len(f"{name} = {image}") for name, image in pairs)
    notes = [found.notes.get(name, "") for name in found.names]
    lines = [
        f"{f'{name} = {image}':{width}}  # {note}" if note else f"{name} = {image}"
        for (name, image), note in zip(pairs, notes)
    ]
    head = [f"# {line}" for line in about.splitlines()]
    with replacing(path) as half_done:
        half_done.write_text("\n".join([*head, f"[{TABLE}]", *lines, ""]), encoding="utf-8")


def short_names(skeleton: Skeleton) -> tuple[str, ...]:
    """Return the name of each joint in maps: its last part, or its path where that is not unique."""
    leaves = [name.rpartition("/")[2] for name in skeleton.joint_names]
    count = Counter(leaves)
    return tuple(leaf if count[leaf] == 1 else name for leaf, name in zip(leaves, skeleton.joint_names))


def ancestors(skeleton: Skeleton, joint: int) -> list[int]:
    """Return the joints above a joint, from the nearest one on."""
    found = []
    while (joint := int(skeleton.parents[joint])) >= 0:
        found.append(joint)
    return found


def owners(skeleton: Skeleton, images: Ints) -> Ints:
    """Return for each joint the nearest one, itself or above it, that another stands for, shape (J,).

    Those of which no such joint is above have the hub.
    """
    found = np.full(skeleton.joint_count, skeleton.hub)
    for joint in range(skeleton.joint_count):
        near = [each for each in (joint, *ancestors(skeleton, joint)) if images[each] >= 0]
        found[joint] = near[0] if near else skeleton.hub
    return found


def height(skeleton: Skeleton) -> float:
    """Return how far joints are apart in height in the bind pose [m]."""
    return float(np.ptp(skeleton.bind_transforms[:, 1, 3])) or 1.0


def size_ratio(own: Skeleton, other: Skeleton, images: Ints) -> float:
    """Return how large another character is, relative to the own one: by the bones between joints of both."""
    lengths = np.zeros(2)
    for joint in np.flatnonzero(images >= 0).tolist():
        above = next((each for each in ancestors(own, joint) if images[each] >= 0), None)
        if above is not None:
            pairs = ((own, joint, above), (other, int(images[joint]), int(images[above])))
            lengths += [np.linalg.norm(np.subtract(*each.bind_transforms[[a, b], :3, 3])) for each, a, b in pairs]
    return float(lengths[1] / lengths[0]) if lengths[0] > 0 else 1.0


def weights_left(skin: SkinWeights, own: Skeleton, images: Ints) -> list[tuple[int, float]]:
    """Return joints that none stands for and that move much of a garment, with their shares of its weight.

    Joints at the place of the one that they move with are left out: they lose little.
    """
    weights, places = skin.dense(own.joint_count).mean(axis=0), own.bind_transforms[:, :3, 3]
    away = np.linalg.norm(places - places[owners(own, images)], axis=1) > AWAY * height(own)
    some = np.flatnonzero((images < 0) & (weights > LEFT) & away)
    return sorted(((int(joint), float(weights[joint])) for joint in some), key=lambda pair: -pair[1])


def heading(own: Skeleton, other: Skeleton, images: Ints) -> Floats:
    """Return the rotation about the vertical that turns another character to face as the own one does, (3, 3).

    It is none where both face alike up to what a bind pose is crooked. Names of sides count where both have them,
    because a body that is turned round has its joints at the same places.
    """
    mapped = np.flatnonzero(images >= 0)
    a = _about_hub(own, own.hub)[mapped][:, [0, 2]]
    b = _about_hub(other, int(images[own.hub]))[images[mapped]][:, [0, 2]]
    angle = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    angle = angle if abs(np.degrees(angle)) > FACING else 0.0
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]])


def named_side(name: str) -> str | None:
    """Return "left" or "right" where a joint's name says so; None elsewhere."""
    found = [side for side, pattern in NAMED_SIDES if pattern.search(name)]
    return found[0] if len(found) == 1 else None


def _about_hub(skeleton: Skeleton, hub: int) -> Floats:
    """Return where joints are about a joint in the bind pose, in heights, shape (J, 3)."""
    places = skeleton.bind_transforms[:, :3, 3]
    return (places - places[hub]) / height(skeleton)


def _places(skeleton: Skeleton) -> dict[str, int]:
    names = short_names(skeleton)
    return {**{name: index for index, name in enumerate(skeleton.joint_names)},
            **{name: index for index, name in enumerate(names)}}  # fmt: skip


def _names(skeleton: Skeleton) -> tuple[str, ...]:
    names = short_names(skeleton)
    return names if len(names) <= LISTED * 10 else (*names[: LISTED * 10], "...")


def leaf(skeleton: Skeleton, joint: int) -> str:
    """Return the last part of a joint's name, for messages."""
    return skeleton.joint_names[joint].rpartition("/")[2]


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else json.dumps(name, ensure_ascii=False)
