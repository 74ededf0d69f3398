# SPDX-License-Identifier: Apache-2.0
"""Propose which joints of another character stand for those of a garment's: by their names, else by their places.

Names are taken apart into a side, a part of the body and a number, whatever a program puts around them (`mixamorig:`,
`DEF-`, `Bip01 L`, `_l`, `.L`). What no name tells is told by where joints are, in terms that no pose changes: the
branch of the skeleton that they are on (trunk, arm, leg), its side, and how far from the hub along the bones, in
heights. Along each branch joints are matched in their order. What differs in number is left without a counterpart.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from ...scene.assets import Floats, Skeleton
from ...scene.joint_map import JointMap, ancestors, height, named_side, short_names

PREFIXES = re.compile(
    r"(?i)^(?:.*[:|]|mixamorig\d*_|def[-_]|org[-_]|bip0*1?[ _]|j_bip_[lrc]_|[mf]_avg_|cc_base_|jnt_|bn_|valvebiped)+"
)
DEFORMING = re.compile(r"(?i)def[-_]")
SUFFIXES = re.compile(r"(?i)[-_. ](?:joint|jnt|bone|bind|skin|m|mid|c)$")
SIDES = re.compile(r"(?i:left|right)|(?:^|(?<=[^A-Za-z]))[LlRr](?=[^A-Za-z]|$)|^[LlRr](?=[A-Z][a-z])|(?<=[a-z])[LR]$")
# The first names of each part are unlike all others; those of `LATER` mean another part where that one has its own.
PARTS = {
    "hips": "hips pelvis hip",
    "spine": "spine chest upperchest chestupper chestlower torso lowerback abdomen abdomenupper abdomenlower waist "
    "ribs ribcage",
    "neck": "neck necklower",
    "head": "head skull",
    "collar": "clavicle collar collarbone scapula shoulder",
    "upper arm": "upperarm uparm arm shldr shldrbend armupper bicep humerus",
    "forearm": "forearm forearmbend lowerarm lowarm elbow armlower",
    "hand": "hand wrist palm",
    "thigh": "upleg thigh thighbend upperleg hip legupper femur",
    "shin": "leg calf shin lowerleg lowleg knee leglower shank",
    "foot": "foot ankle",
    "toe": "toe toebase toes ball",
}
WORDS = {word: part for part, words in reversed(list(PARTS.items())) for word in words.split()}
# SMPL's shoulder is the upper arm, beside a collar, and its foot the toes, beside an ankle.
LATER = {("shoulder", "collar clavicle collarbone scapula"): "upper arm", ("foot", "ankle"): "toe"}
SIDED = ("collar", "upper arm", "forearm", "hand", "thigh", "shin", "foot", "toe")
FINGERS = re.compile(r"thumb|index|middle|ring|pinky|little|finger|metacarpal|meta|carpal")
OTHERS = re.compile(r"twist|roll|end|nub|helper|corrective|ik|pole|breast|pec|eye|jaw|tongue|weapon|attach|prop")
ARM, LEG, TRUNK = "arm", "leg", "trunk"
LIMBS = {ARM: ("collar", "upper arm", "forearm", "hand"), LEG: ("thigh", "shin", "foot", "toe")}
TOLERANCE = 0.12  # of the height, by which joints that stand for each other are otherwise far from the hub
DOWN = 0.15  # of the height, from the hub to the end of a leg at least
AT_HIPS = 0.08  # of the height, within which of the thighs hips are
OUT = 0.08  # of the height, from the middle to the end of an arm at least


@dataclass(frozen=True)
class _Named:
    """What a joint's name says: a part of the body or "", a side or None, and a number, 0 without one."""

    part: str
    side: str | None
    number: int


@dataclass(eq=False)
class _Figure:
    """A skeleton as it is compared with another one.

    Attributes:
        branches: indices of the joints of each branch from the hub outwards, by kind and side ("" of the trunk).
        reach: distance of each joint from the hub along the bones, in heights, shape (J,).
    """

    skeleton: Skeleton
    named: list[_Named]
    reach: Floats
    branches: dict[tuple[str, str], list[int]] = field(default_factory=dict)


def propose(own: Skeleton, other: Skeleton, path: str) -> JointMap:
    """Return which joints of another character stand for the own ones; `path` is that of the map, for messages."""
    figures = _figure(own), _figure(replace(other, hub=_hips(other)))
    pairs: dict[int, tuple[int, str]] = {own.hub: (figures[1].skeleton.hub, "")}
    for branch, mine in figures[0].branches.items():
        its = figures[1].branches.get(branch, [])
        found = _aligned(figures, mine, its)
        pairs |= found
    pairs |= _by_whole_name(figures, pairs)
    names, others = short_names(own), short_names(other)
    images, notes = {}, {}
    for joint, name in enumerate(names):
        image, how = pairs.get(joint, (-1, ""))
        images[name] = others[image] if image >= 0 else ""
        notes[name] = _note(figures, joint, image, how, pairs, names)
    return JointMap(path, images, notes)


def _hips(skeleton: Skeleton) -> int:
    """Return the joint that stands for hips: the one of that name, else the hub.

    Where the hub is no joint between spine and thighs, as where limbs have roots of their own, it is the joint there
    from which these hang, else the lowest one of the spine.
    """
    named, heights = _read_names(_leaves(skeleton)), skeleton.bind_transforms[:, 1, 3] / height(skeleton)
    hips = [joint for joint, each in enumerate(named) if each.part == "hips"]
    if hips:
        return min(hips, key=lambda joint: (joint != skeleton.hub, len(ancestors(skeleton, joint))))
    spine, thighs = ([joint for joint, each in enumerate(named) if each.part == part] for part in ("spine", "thigh"))
    if not (spine and thighs) or skeleton.hub in spine:
        return skeleton.hub
    lowest, level = min(spine, key=lambda joint: heights[joint]), heights[thighs].max()
    ways = [{joint, *ancestors(skeleton, joint)} for joint in (lowest, *thighs)]
    shared = [joint for joint in set.intersection(*ways) if abs(heights[joint] - level) < AT_HIPS]
    if shared:
        return max(shared, key=lambda joint: len(ancestors(skeleton, joint)))
    return lowest if heights[lowest] < level + AT_HIPS else skeleton.hub


def _leaves(skeleton: Skeleton) -> list[str]:
    return [name.rpartition("/")[2] for name in skeleton.joint_names]


def _note(figures: Sequence[_Figure], joint: int, image: int, how: str, pairs: Mapping, names: Sequence[str]) -> str:
    own = figures[0].skeleton
    if joint == own.hub:
        return "carries the body"
    if image < 0:
        above = next((each for each in ancestors(own, joint) if each in pairs), own.hub)
        return f"none: moves with {names[above]}"
    if how == "place":
        apart = abs(figures[0].reach[joint] - figures[1].reach[image])
        return f"by place, {100 * apart:.0f} % of the height off"
    return f"by {how}"


def _figure(skeleton: Skeleton) -> _Figure:
    leaves = _leaves(skeleton)
    reach = _reaches(skeleton) / height(skeleton)
    figure = _Figure(skeleton, _read_names(leaves), reach)
    figure.branches = _branches(figure, leaves)
    return figure


def _reaches(skeleton: Skeleton) -> Floats:
    """Return how far joints are from the hub along the bones [m], shape (J,).

    Limbs with roots of their own are taken to hang from the nearest joint, the nearest limb first.
    """
    places, parents = skeleton.bind_transforms[:, :3, 3], skeleton.parents
    found = np.full(skeleton.joint_count, np.inf)
    found[skeleton.hub] = 0
    for below, above in pairwise([skeleton.hub, *ancestors(skeleton, skeleton.hub)]):
        found[above] = found[below] + np.linalg.norm(places[above] - places[below])
    while True:
        for joint in range(skeleton.joint_count):
            if np.isinf(found[joint]) and parents[joint] >= 0:
                found[joint] = found[parents[joint]] + np.linalg.norm(places[joint] - places[parents[joint]])
        held, loose = np.flatnonzero(np.isfinite(found)), np.flatnonzero(np.isinf(found) & (parents < 0))
        if not len(loose):
            return found
        away = np.linalg.norm(places[loose, None] - places[held], axis=-1)
        root, near = np.unravel_index(int(away.argmin()), away.shape)
        found[loose[root]] = found[held[near]] + away[root, near]


def _read_names(leaves: Sequence[str]) -> list[_Named]:
    bare = _bare_names(leaves)
    words = {word for word, _, _ in bare}
    found = []
    for word, side, number in bare:
        part = WORDS.get(word, "")
        for (of, beside), other in LATER.items():
            theirs = (words - {of}) & set(PARTS[other].split())
            part = other if word == of and side and words & set(beside.split()) and not theirs else part
        if word == "hip":
            part = "thigh" if side else "hips"
        if (part in SIDED and not side) or (part not in SIDED and side):
            part = ""  # such as a pelvis of each side
        found.append(_Named(part, side, number))
    return found


def _bare_names(leaves: Sequence[str]) -> list[tuple[str, str | None, int]]:
    """Return what `_bare` makes of names; of control rigs, of those joints alone that deform."""
    deforming = [bool(DEFORMING.match(leaf)) for leaf in leaves]
    return [_bare(leaf) if each or not any(deforming) else ("", None, 0) for leaf, each in zip(leaves, deforming)]


def _bare(leaf: str) -> tuple[str, str | None, int]:
    """Return a name without what programs put around it, its side and its number."""
    text, side = PREFIXES.sub("", leaf), named_side(leaf)
    text = SUFFIXES.sub("", text)
    digits = re.findall(r"\d+", text)
    if side:
        text = SIDES.sub(" ", text, count=1)
    return re.sub(r"[^a-z]", "", text.lower()), side, int(digits[-1]) if digits else 0


def _branches(figure: _Figure, leaves: Sequence[str]) -> dict[tuple[str, str], list[int]]:
    """Return the joints of trunk and limbs, from the hub outwards.

    A limb's are told by their names where these say it. Where no name of a kind and side does, they are those on the
    way to what is farthest out, or lowest, on that side.
    """
    skeleton, found = figure.skeleton, dict[tuple[str, str], list[int]]()
    for kind, parts in LIMBS.items():
        for side in ("left", "right"):
            named = [joint for joint, each in enumerate(figure.named) if each.side == side and each.part in parts]
            if named:
                order = {joint: (parts.index(figure.named[joint].part), figure.reach[joint]) for joint in named}
                found[kind, side] = sorted(named, key=order.__getitem__)
    missing = [(kind, side) for kind in LIMBS for side in ("left", "right") if (kind, side) not in found]
    found |= {branch: way for branch, way in _by_place(figure).items() if branch in missing}
    limbs = {joint for branch in found.values() for joint in branch}
    heads = [joint for joint, each in enumerate(figure.named) if each.part == "head"]
    top = heads[0] if heads else _top(figure, limbs)
    trunk = [joint for joint in _way(skeleton, top) if joint not in limbs]
    spine = [joint for joint, each in enumerate(figure.named) if each.part in ("spine", "neck", "head")]
    if len(trunk) < len(spine):  # they do not hang from each other
        trunk = sorted({*spine} - {skeleton.hub}, key=lambda joint: skeleton.bind_transforms[joint, 1, 3])
    found[TRUNK, ""] = [joint for joint in trunk if not OTHERS.search(leaves[joint].lower())]
    return found


def _way(skeleton: Skeleton, end: int) -> list[int]:
    """Return the joints from below the hub to an end."""
    way = [end, *ancestors(skeleton, end)]
    return list(reversed(way[: way.index(skeleton.hub)])) if skeleton.hub in way else [end]


def _top(figure: _Figure, limbs: set[int]) -> int:
    heights = figure.skeleton.bind_transforms[:, 1, 3]
    middle = np.abs(_beside(figure.skeleton)) < OUT / 2
    joints = [joint for joint in np.flatnonzero(middle).tolist() if joint not in limbs]
    return max(joints or [figure.skeleton.hub], key=lambda joint: heights[joint])


def _by_place(figure: _Figure) -> dict[tuple[str, str], list[int]]:
    """Return the limbs that names do not tell, as the ways to the ends farthest from the hub on each side."""
    skeleton, beside = figure.skeleton, _beside(figure.skeleton)
    up = (skeleton.bind_transforms[:, 1, 3] - skeleton.bind_transforms[skeleton.hub, 1, 3]) / height(skeleton)
    leaves = [joint for joint in range(skeleton.joint_count) if not (skeleton.parents == joint).any()]
    found = {}
    for side, sign in (("left", 1), ("right", -1)):
        for kind in LIMBS:
            ends = [
                joint
                for joint in leaves
                if sign * beside[joint] > (OUT if kind == ARM else 0.01) and (up[joint] < -DOWN) == (kind == LEG)
            ]
            if kind == ARM:  # hands may hang below the hips; legs begin beneath the hub
                ends += [
                    joint
                    for joint in leaves
                    if sign * beside[joint] > OUT and up[_way(skeleton, joint)].max() > DOWN and joint not in ends
                ]
            else:
                ends = [joint for joint in ends if up[_way(skeleton, joint)].max() < DOWN]
            if ends:
                found[kind, side] = _own_way(skeleton, max(ends, key=lambda joint: figure.reach[joint]), kind, beside)
    return found


def _own_way(skeleton: Skeleton, end: int, kind: str, beside: Floats) -> list[int]:
    """Return the joints of a limb alone: those on the way to its end that are beside the middle."""
    return [joint for joint in _way(skeleton, end) if abs(beside[joint]) > 0.01]


def _beside(skeleton: Skeleton) -> Floats:
    """Return how far joints are to the left of the hub in the bind pose, in heights, shape (J,).

    Left is where names say so, else by where the feet point, else +x.
    """
    places = skeleton.bind_transforms[:, :3, 3]
    about = (places - places[skeleton.hub]) / height(skeleton)
    sides = [named_side(name.rpartition("/")[2]) for name in skeleton.joint_names]
    signs = np.array([{"left": 1.0, "right": -1.0}.get(side or "", 0.0) for side in sides])
    axis = signs @ about
    axis[1] = 0
    if np.linalg.norm(axis) < OUT:
        low = about[:, 1] < about[:, 1].min() + 0.1
        forward = about[low].mean(axis=0) - about[[*skeleton.hub_path[-1:]]].mean(axis=0)
        ends = [joint for joint in np.flatnonzero(low).tolist() if not (skeleton.parents == joint).any()]
        steps = [about[joint] - about[skeleton.parents[joint]] for joint in ends if skeleton.parents[joint] >= 0]
        forward = np.sum(steps, axis=0) if steps else forward
        forward[1] = 0
        # Left is up x forward.
        axis = np.cross([0.0, 1.0, 0.0], forward) if np.linalg.norm(forward) > 0.01 else np.array([1.0, 0, 0])
    return about @ (axis / np.linalg.norm(axis))


def _aligned(figures: Sequence[_Figure], mine: Sequence[int], its: Sequence[int]) -> dict[int, tuple[int, str]]:
    """Return which joints of a branch stand for each other: the first of each part, and between these by place."""
    found = dict[int, tuple[int, str]]()
    parts = [[figure.named[joint].part for joint in branch] for figure, branch in zip(figures, (mine, its))]
    fixed = list[tuple[int, int]]()
    for row, part in enumerate(parts[0]):
        begins = part not in ("", "spine") and parts[0].index(part) == row and part in parts[1]
        if begins and (not fixed or parts[1].index(part) > fixed[-1][1]):
            fixed.append((row, parts[1].index(part)))
    for row, column in fixed:
        found[mine[row]] = its[column], "name"
    begin = (-1, -1)
    for end in [*fixed, (len(mine), len(its))]:
        rows, columns = mine[begin[0] + 1 : end[0]], its[begin[1] + 1 : end[1]]
        spans = [_span(figure, branch, at[0], at[1]) for figure, branch, at in
                 ((figures[0], mine, (begin[0], end[0])), (figures[1], its, (begin[1], end[1])))]  # fmt: skip
        found |= _in_order(figures, rows, columns, spans)
        begin = end
    return found


def _span(figure: _Figure, branch: Sequence[int], first: int, last: int) -> tuple[float, float]:
    """Return the reaches between which the joints of a part of a branch lie; infinite behind its end."""
    start = 0.0 if first < 0 else float(figure.reach[branch[first]])
    return start, float(figure.reach[branch[last]]) if last < len(branch) else np.inf


def _in_order(
    figures: Sequence[_Figure], mine: Sequence[int], its: Sequence[int], spans: Sequence[tuple[float, float]]
) -> dict[int, tuple[int, str]]:
    """Match joints in their order so that reaches differ least; leaving one out costs as much as `TOLERANCE`."""
    if not mine or not its:
        return {}
    at = []
    for figure, joints, (low, high) in zip(figures, (mine, its), spans):
        reach = figure.reach[list(joints)]
        at.append(reach if np.isinf(high) or high <= low else (reach - low) / (high - low))
    between = not np.isinf(spans[0][1])
    most = 1.0 if between else TOLERANCE
    apart = np.abs(at[0][:, None] - at[1][None])
    costs = np.zeros((len(mine) + 1, len(its) + 1))
    costs[1:, 0] = most * np.arange(1, len(mine) + 1)
    for row in range(1, len(mine) + 1):
        for column in range(1, len(its) + 1):
            taken = costs[row - 1, column - 1] + apart[row - 1, column - 1]
            costs[row, column] = min(costs[row, column - 1], costs[row - 1, column] + most, taken)
    found, row, column = {}, len(mine), len(its)
    while row and column:
        if costs[row, column] == costs[row, column - 1]:
            column -= 1
        elif costs[row, column] == costs[row - 1, column] + most:
            row -= 1
        else:
            row, column = row - 1, column - 1
            names = [figure.named[joint] for figure, joint in zip(figures, (mine[row], its[column]))]
            how = "name and place" if names[0].part and names[0].part == names[1].part else "place"
            found[mine[row]] = its[column], how
    return found


def _by_whole_name(figures: Sequence[_Figure], pairs: Mapping[int, tuple[int, str]]) -> dict[int, tuple[int, str]]:
    """Return joints of fingers and others whose bare names, sides and numbers are the same on both."""
    taken = {image for image, _ in pairs.values()}
    keys: list[dict[tuple, list[int]]] = []
    for figure in figures:
        found: dict[tuple, list[int]] = {}
        for joint, bare in enumerate(_bare_names(_leaves(figure.skeleton))):
            found.setdefault(bare, []).append(joint)
        keys.append(found)
    matched = {}
    for key, joints in keys[0].items():
        its = keys[1].get(key, [])
        if len(joints) == len(its) == 1 and joints[0] not in pairs and its[0] not in taken and key[0]:
            matched[joints[0]] = its[0], "name"
    return matched
