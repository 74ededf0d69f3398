# SPDX-License-Identifier: Apache-2.0
"""Read how an animator directs a garment: where it is held to linear blend skinning, how long each pose is held, and
whether the shot is a cycle.

All are attributes of the garment's prim, in the shot or in the character's stage: `ssilk:free`, a number that may be
keyed, `ssilk:hold`, a whole number, and `ssilk:loop`, a bool. A shot that plays a clip alone may have an `over` at
the garment's path. `ssilk:free:NAME` says so of a part of the garment, and `ssilk:posed:NAME` that its proxies are as
the shot's own animation has them. NAME is a proxy, by the last part of its joint's path, or a UsdGeomSubset of the
mesh.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from types import MappingProxyType
from typing import NoReturn

import numpy as np
from pxr import Sdf, Usd, UsdGeom, UsdSkel

from ssilk_core.errors import did_you_mean, fail
from ssilk_core.files import split_location
from ssilk_core.scene.assets import Floats, Ints, Motion, Scene
from ssilk_core.scene.held_parts import hand_pose
from ssilk_core.scene.kinematics import MAX_HOLD, local_transforms, sample_motion

from ..names import FREE, HOLD, LOOP, POSED
from ..opening.stage import PRIMS, explains_damage, has_value, listed, location, open_stage
from ..opening.times import change_times, samples_about
from .mesh import is_garment
from .motion import find_animation, read_motion
from .skin import match_joints

DIRECTING = FREE, HOLD, LOOP, POSED
PRIMVARS = "primvars:"
POSING = UsdSkel.Root, UsdSkel.Skeleton, UsdSkel.Animation
ROUNDING = 1e-6
MOST_NAMES = 6  # in a message
NEAR = 0.7  # likeness of names from which on one may be the other misspelt


@dataclass(frozen=True, eq=False)
class SaidPart:
    """How a part of a garment is held.

    Attributes:
        where: the attribute, for messages.
        name: of the part.
        share: by which it is held at each frame of the motion, 0 to 1, shape (F,).
        posed: whether to a pose by hand, in place of linear blend skinning.
        vertices: of a subset, shape (N,); None where the part is a proxy.
    """

    where: str
    name: str
    share: Floats
    posed: bool
    vertices: Ints | None


@dataclass(frozen=True, eq=False)
class SaidDirection:
    """What stages say.

    Attributes:
        free: at each frame of the motion, 0 to 1, shape (F,); None where it is 1 throughout.
        hold: frames that each pose is held.
        parts: those that are held by themselves.
        unheard: of prims that direct nothing, and may be meant to.
    """

    free: Floats | None
    hold: int
    parts: tuple[SaidPart, ...] = ()
    unheard: tuple[str, ...] = ()


@explains_damage
def read_direction(
    source: str, stage: str, garment: Sequence[str], motion: Motion, proxies: Sequence[str] = ()
) -> SaidDirection:
    """Return how a garment is directed over a motion.

    Args:
        source: of the motion, "file[:/Prim/Path]".
        stage: the character's file.
        garment: paths by which the garment is known, that in the stage first; without any nothing is said.
        proxies: of the model, joint paths.

    Raises:
        SsilkError: a value is no number or out of range, several prims of the shot may be the garment, or a part is
            neither a proxy nor a subset.
    """
    file, _ = split_location(source)
    shot, home = open_stage(file), open_stage(stage)
    prims = _prims(shot, home, source, garment, motion)
    for prim in prims:
        _refuse_misspelt(prim)
    free = next((prim for prim in prims if has_value(prim, FREE)), None)
    hold = next((prim for prim in prims if has_value(prim, HOLD)), None)
    seconds = (motion.start + np.arange(motion.frame_count)) / motion.fps
    parts = tuple(_parts(prims, seconds, {name.rpartition("/")[2] for name in proxies}))
    unheard = tuple(dict.fromkeys(text for each in (shot, home) for text in _unheard(each, home, garment, prims)))
    return SaidDirection(_free(free, seconds) if free else None, _hold(hold) if hold else 1, parts, unheard)


@explains_damage
def read_hand_pose(
    source: str,
    scene: Scene,
    motion: Motion,
    root: str | None,
    needed: Sequence[str],
    moves: Mapping[str, Floats] = MappingProxyType({}),
) -> Floats:
    """Return where the animation of a shot has a garment's proxies, as `HeldParts.hand`; those it lacks are at rest.

    Args:
        motion: at whose frames.
        root: the character, as for `read_motion`.
        needed: proxies that it must have, joint paths.
        moves: how far each that it has is from there, along its parent's axes [m], shape (3,).

    Raises:
        SsilkError: it lacks one.
    """
    skeleton, rig = scene.character.skeleton, scene.rig
    file, prim = split_location(source)
    shot = open_stage(file)  # prims live as long as it
    animation, _ = find_animation(shot, prim, root)
    animated = tuple(str(name) for name in UsdSkel.Animation(animation).GetJointsAttr().Get() or ())
    there = dict(zip(rig.joint_names, match_joints(rig.joint_names, animated)))
    for name in needed:
        if there[name] < 0:
            what = f"{POSED} asks for proxy '{name}' as it was posed, and this animation has no such joint"
            fail(location(animation), what, "it needs the proxies among its joints", "animate it, or say ssilk:free")
    rest = local_transforms(scene.bind_transforms, scene.parents)[skeleton.joint_count :]
    whole = replace(
        skeleton,
        joint_names=(*skeleton.joint_names, *rig.joint_names),
        parents=scene.parents,
        bind_transforms=scene.bind_transforms,
        rest_transforms=np.concatenate([skeleton.rest_transforms, rest]),
        scales=None if skeleton.scales is None else np.append(skeleton.scales, np.ones(len(rest))),
    )
    every = read_motion(source, whole, root=root)
    at = (motion.start + np.arange(motion.frame_count)) / motion.fps * every.fps - every.start
    rotations, translations = sample_motion(every, at.clip(0, every.frame_count - 1))
    none = np.zeros(3)
    off = [none if there[name] < 0 else moves.get(name, none) for name in rig.joint_names]
    translations[:, skeleton.joint_count :] += np.array(off).reshape(-1, 3)
    return hand_pose(scene, Motion(every.path, motion.fps, rotations, translations))


@explains_damage
def read_loop(source: str, stage: str, garment: Sequence[str], motion: Motion) -> bool:
    """Return whether a shot is said to be a cycle; arguments and errors as `read_direction`."""
    file, _ = split_location(source)
    shot, home = open_stage(file), open_stage(stage)  # prims live as long as these
    prim = next((prim for prim in _prims(shot, home, source, garment, motion) if has_value(prim, LOOP)), None)
    if prim is None:
        return False
    found = prim.GetAttribute(LOOP).Get()
    if change_times([prim.GetAttribute(LOOP)]) or not isinstance(found, bool):
        fail(location(prim), f"{LOOP} is {str(found)[:40]}", "true or false is needed, without time samples")
    return found


def _prims(shot: Usd.Stage, home: Usd.Stage, source: str, garment: Sequence[str], motion: Motion) -> list[Usd.Prim]:
    """Return the garment's prims in the shot, then in the character's stage."""
    _, placed = find_animation(shot, split_location(source)[1] or split_location(motion.path)[1], None)
    there = [prim for path in garment for prim in _in_shot(shot, path, placed)]
    return list(dict.fromkeys([*there, *filter(None, map(home.GetPrimAtPath, garment))]))


def _in_shot(shot: Usd.Stage, garment: str, placed: Usd.Prim | None) -> list[Usd.Prim]:
    """Return the garment's prim in a shot; none where the shot has no such prim."""
    root = UsdSkel.Root.Find(placed).GetPrim() if placed else None
    name = garment.rsplit("/", 1)[-1]
    worn = [
        prim
        for prim in (Usd.PrimRange(root, PRIMS) if root else ())
        if prim.IsA(UsdGeom.Mesh) and prim.GetName() == name and is_garment(prim)
    ]
    if len(worn) > 1:
        what = f"several garments may be {name}: {listed(worn)}"
        fail(str(shot.GetRootLayer().identifier), what, "one is needed", "rename or deactivate the others")
    there = shot.GetPrimAtPath(garment)
    return worn or ([there] if there else [])


def _refuse_misspelt(prim: Usd.Prim) -> None:
    """Refuse attributes whose names are nearly those that direct a garment: they would direct nothing."""
    for attribute in prim.GetPropertiesInNamespace("ssilk"):
        name = attribute.GetName()
        if _base(name) not in DIRECTING and (near := get_close_matches(_base(name), DIRECTING, n=1, cutoff=0.88)):
            _fail_misspelt(prim, name, near[0])
    for attribute in prim.GetPropertiesInNamespace(f"{PRIMVARS}ssilk"):
        meant = attribute.GetName().removeprefix(PRIMVARS)
        if _base(meant) in DIRECTING:
            _fail_misspelt(prim, attribute.GetName(), meant)


def _fail_misspelt(prim: Usd.Prim, name: str, near: str) -> NoReturn:
    fail(
        location(prim), f"an attribute {name}", f"{', '.join(DIRECTING)} direct a garment", f"did you mean '{near}'?"
    )


def _unheard(stage: Usd.Stage, home: Usd.Stage, garment: Sequence[str], prims: Sequence[Usd.Prim]) -> Iterator[str]:
    """Yield of prims that direct nothing, though their attributes would direct a garment.

    That are what poses a character, and prims above the garment. They are also prims without a type whose names are
    nearly the garment's. Of these there is nothing to tell where the stage directs the garment itself: they may be of
    another character.
    """
    leaves = [path.rpartition("/")[2].lower() for path in garment]
    own = [prim for prim in prims if prim.GetStage() == stage]
    paths = [*map(Sdf.Path, garment), *(prim.GetPath() for prim in own)]
    directed = any(map(_directing, own))
    for prim in stage.TraverseAll():
        if prim in own or not (said := _directing(prim)):
            continue
        text = f"{location(prim)}: {said[0]} directs nothing"
        if any(map(prim.IsA, POSING)) or any(path.HasPrefix(prim.GetPath()) for path in paths):
            kind = prim.GetTypeName() or "prim above the garment"
            yield f"{text} on a {kind}; it is an attribute of the garment, {garment[0]}, put it there"
            continue
        there = home.GetPrimAtPath(prim.GetPath())
        if directed or prim.GetTypeName() or (there and there.GetTypeName()):
            continue
        if get_close_matches(prim.GetName().lower(), leaves, cutoff=NEAR):
            yield f"{text}; the garment is {garment[0]}, rename the prim if that is meant"


def _base(name: str) -> str:
    """Return the name of an attribute without that of the part of a garment that it is of."""
    return ":".join(name.split(":", 2)[:2])


def _directing(prim: Usd.Prim) -> list[str]:
    """Return the names of a prim's attributes that direct a garment."""
    names = (attribute.GetName() for attribute in prim.GetPropertiesInNamespace("ssilk"))
    return [name for name in names if _base(name) in DIRECTING]


def _parts(prims: Sequence[Usd.Prim], seconds: Floats, proxies: set[str]) -> Iterator[SaidPart]:
    """Yield the parts that any of a garment's prims says to be held; the first that says it of a part counts."""
    told = set[str]()
    for prim in prims:
        for attribute in (*prim.GetPropertiesInNamespace(FREE), *prim.GetPropertiesInNamespace(POSED)):
            what = attribute.GetName()
            if what in told or not has_value(prim, what):
                continue
            told.add(what)
            name, posed = what.split(":", 2)[2], what.startswith(POSED)
            values = _keyed(prim, what, seconds)
            vertices = None if name in proxies else _subset(prims, name)
            if name not in proxies and vertices is None:
                subsets = sorted({child.GetName() for each in prims for child in _subsets(each)})
                found = f"{what} names neither a proxy of the model nor a subset of the garment"
                allowed = f"its subsets: {_named(subsets)}; its proxies: {_named(sorted(proxies))}"
                fail(location(prim), found, allowed, did_you_mean(name, [*subsets, *proxies]) or "rename it")
            share = values if posed else 1 - values
            if share.any():
                yield SaidPart(f"{location(prim)}.{what}", name, share, posed, vertices)


def _subsets(prim: Usd.Prim) -> list[Usd.Prim]:
    return [child for child in prim.GetFilteredChildren(PRIMS) if child.IsA(UsdGeom.Subset)]


def _named(names: Sequence[str]) -> str:
    return ", ".join([*names[:MOST_NAMES], *(["..."] if len(names) > MOST_NAMES else [])]) or "none"


def _subset(prims: Sequence[Usd.Prim], name: str) -> Ints | None:
    """Return the vertices of a subset of a garment; None where it has none of this name."""
    found = next((child for prim in prims if (child := UsdGeom.Subset(prim.GetChild(name)))), None)
    if found is None:
        return None
    rows = np.array(found.GetIndicesAttr().Get(Usd.TimeCode.EarliestTime()), dtype=np.int64).reshape(-1)
    meshes = [prim for prim in prims if has_value(prim, "faceVertexIndices")]  # an over may have none
    if not meshes:
        fail(location(found.GetPrim()), "a subset of a mesh without faces", "a garment has some", "look at the stage")
    mesh = UsdGeom.Mesh(meshes[0])
    corners = np.array(mesh.GetFaceVertexIndicesAttr().Get(Usd.TimeCode.EarliestTime()), dtype=np.int64).reshape(-1)
    kind, most = found.GetElementTypeAttr().Get(), int(corners.max(initial=-1)) + 1
    if kind == UsdGeom.Tokens.face:
        counts = np.array(mesh.GetFaceVertexCountsAttr().Get(Usd.TimeCode.EarliestTime()), dtype=np.int64)
        chosen, most = rows, len(counts)
        rows = corners[np.isin(np.repeat(np.arange(most), counts), rows)]
    else:
        chosen = rows
    if kind not in (UsdGeom.Tokens.face, UsdGeom.Tokens.point) or not ((chosen >= 0) & (chosen < most)).all():
        allowed = f"points or faces are allowed, of which there are {most}"
        fail(location(found.GetPrim()), f"a subset of {kind}s {chosen[:3].tolist()}, ...", allowed, "choose it again")
    return np.unique(rows)


def _free(prim: Usd.Prim, seconds: Floats) -> Floats | None:
    values = _keyed(prim, FREE, seconds)
    return None if (values == 1).all() else values


def _keyed(prim: Usd.Prim, name: str, seconds: Floats) -> Floats:
    """Return a number from 0 to 1 at each time (F,)."""
    attribute, second = prim.GetAttribute(name), prim.GetStage().GetTimeCodesPerSecond()
    codes = seconds * second if change_times([attribute]) else seconds[:1] * second
    found = [attribute.Get(Usd.TimeCode(float(code))) for code in codes]
    try:
        values = np.array(found, dtype=float)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.shape != codes.shape:
        fail(location(prim), f"{name} is {str(found[0])[:40]}", "a number from 0 to 1 is needed")
    bad = ~((values >= -ROUNDING) & (values <= 1 + ROUNDING))
    if bad.any():
        at = int(np.argmax(bad))
        wrong, code = float(values[at]), float(codes[at])
        for key in samples_about(attribute, code):  # what somebody has keyed, in place of what is made of it
            if not 0 <= (keyed := float(attribute.Get(key))) <= 1:
                wrong, code = keyed, key
                break
        held = "held to linear blend skinning, to 1, free"
        ends = "the network's, to 1, posed by hand" if name.startswith(POSED) else held
        allowed = f"0, {ends}, are allowed"
        fail(location(prim), f"{name} is {wrong:g} at time code {code:g}", allowed)
    return np.broadcast_to(values.clip(0, 1), seconds.shape)


def _hold(prim: Usd.Prim) -> int:
    attribute = prim.GetAttribute(HOLD)
    if change_times([attribute]):
        fail(location(prim), f"{HOLD} changes over time", "a shot has one", "give it a value without time samples")
    found = attribute.Get()
    number = isinstance(found, int | float) and not isinstance(found, bool)
    if not (number and 1 <= found <= MAX_HOLD and found == int(found)):
        allowed = f"a whole number of frames from 1 to {MAX_HOLD} is needed"
        fail(location(prim), f"{HOLD} is {str(found)[:40]}", allowed)
    return int(found)
