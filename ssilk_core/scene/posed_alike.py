# SPDX-License-Identifier: Apache-2.0
"""A character with another skeleton, posed as a garment's own character is bound.

Limbs point where those of the own character point, and all else is as the character is bound: joints within a trunk
lie elsewhere in each rig without a trunk being bent. In that pose the garment lies on the other character as on its
own, and what moves each joint of the own one on from there is the joint of the other one that stands for it. So a
network sees the joints that it was trained on, carried by those of the other character (`SeenJoints`), whatever
names, axes and bind pose these have.
"""

from __future__ import annotations

from collections.abc import Callable, Container
from dataclasses import dataclass, replace

import numpy as np

from ..errors import fail
from .assets import Body, Character, Floats, Ints, Motion, ProxyRig, Skeleton, SkinWeights
from .assets.skeleton import SeenJoints
from .joint_map import ancestors, heading, height, leaf, owners
from .kinematics import invert_rigid, local_transforms, rigid, skin_points

LONG = 0.11  # of the height, from which on a bone is a limb's, not one of hands, feet, collar or spine
BESIDE = 0.035  # of the height, by which it is beside the hub
LOW = 0.12  # of the height over the lowest joint, below which joints are feet
LEAN = 10.0  # [degrees] from which on a trunk is bound leaning, and not only with its joints elsewhere
FLAT = 0.02  # of the largest principal value of joints, below which they lie on a line
TURNED = 10.0  # [degrees] by which a limb is bound otherwise, from which on it is told
UNLIKE = 135.0  # [degrees] by which a limb is bound otherwise, from which on it is not known how it was turned


@dataclass(frozen=True, eq=False)
class PosedAlike:
    """Another character in the bind pose of a garment's own.

    Attributes:
        transforms: its joints to the world, shape (J', 4, 4).
        turned: by which each joint turns from where it is bound, beyond the trunk [degrees], shape (J',).
        upright: rotation that makes its trunk stand and face as that of the garment's character, shape (3, 3).
    """

    transforms: Floats
    turned: Floats
    upright: Floats


def alike(own: Skeleton, other: Skeleton, images: Ints) -> PosedAlike:
    """Return another character in the bind pose of a garment's own.

    Args:
        images: the joint of the other one that stands for each of the own ones, or -1, shape (J,).

    Raises:
        SsilkError: a limb is bound so far from the own one that it does not say how it was turned.
    """
    binds, wanted = other.bind_transforms, _limbs(own, other, images)
    turn = _upright(own, other, images, wanted)
    feet = _feet(other)
    turns, places = np.empty((other.joint_count, 3, 3)), np.empty((other.joint_count, 3))
    hub = binds[images[own.hub], :3, 3]
    for joint, parent in enumerate(other.parents.tolist()):
        at = binds[joint, :3, 3]
        if parent < 0:
            turns[joint], places[joint] = turn, hub + turn @ (at - hub)
        else:
            turns[joint] = turns[parent]
            places[joint] = places[parent] + turns[parent] @ (at - binds[parent, :3, 3])
        if joint in feet:
            turns[joint] = turn
        elif joint in wanted:
            end, direction = wanted[joint]
            turns[joint] = _swing(turns[joint] @ (binds[end, :3, 3] - at), direction) @ turns[joint]
    angles = rotation_angles(np.swapaxes(turn, 0, 1) @ turns)
    joint = int(angles.argmax())
    if angles[joint] > UNLIKE:
        found = f"'{leaf(other, joint)}' is bound {angles[joint]:.0f} degrees from where {own.path} has it"
        fail(other.path, found, f"up to {UNLIKE:.0f} degrees are allowed", "bind it in an A-pose or a T-pose")
    return PosedAlike(rigid(turns @ binds[:, :3, :3], places), angles, turn)


def _upright(own: Skeleton, other: Skeleton, images: Ints, limbs: Container[int]) -> Floats:
    """Return the rotation (3, 3) with which the trunk of another character stands as the own one does.

    It is a heading where the trunk is bound upright, as far as that can be told of joints that lie elsewhere in it.
    """
    turn, places = heading(own, other, images), own.bind_transforms[:, :3, 3]
    trunk = [joint for joint in np.flatnonzero(images >= 0).tolist()
             if not any(int(images[each]) in limbs for each in ancestors(own, joint))]  # fmt: skip
    its = other.bind_transforms[images[trunk], :3, 3]
    hub = other.bind_transforms[images[own.hub], :3, 3]
    a = (places[trunk] - places[own.hub]) / height(own)
    b = (its - hub) @ turn.T / height(other)
    left, values, right = np.linalg.svd(a.T @ b)
    if values[1] < FLAT * values[0]:  # joints on a line say nothing of turns about it
        return turn
    lean = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    return lean @ turn if rotation_angles(lean) > LEAN else turn


def rotation_angles(rotations: Floats) -> Floats:
    """Return angles [degrees] of rotations (..., 3, 3)."""
    return np.degrees(np.arccos(((np.trace(rotations, axis1=-2, axis2=-1) - 1) / 2).clip(-1, 1)))


def _limbs(own: Skeleton, other: Skeleton, images: Ints) -> dict[int, tuple[int, Floats]]:
    """Return for joints of the other character that begin a bone of a limb its end, and where the own one points."""
    places, its = own.bind_transforms[:, :3, 3], other.bind_transforms[:, :3, 3]
    found = dict[int, tuple[int, Floats]]()
    for end in np.flatnonzero(images >= 0).tolist():
        above = [joint for joint in ancestors(own, end) if images[joint] >= 0]
        if not above or images[above[0]] not in ancestors(other, int(images[end])):
            continue
        joint = above[0]
        bones = ((places, own, joint, end), (its, other, int(images[joint]), int(images[end])))
        lengths = [np.linalg.norm(at[to] - at[of]) / height(each) for at, each, of, to in bones]
        beside = np.linalg.norm((places[joint] - places[own.hub])[[0, 2]]) / height(own)
        if min(lengths) > LONG and beside > BESIDE:
            found[int(images[joint])] = int(images[end]), places[end] - places[joint]
    return found


def _feet(skeleton: Skeleton) -> set[int]:
    """Return the joints of feet: they stand on the ground in any bind pose."""
    heights = skeleton.bind_transforms[:, 1, 3]
    return set(np.flatnonzero(heights < heights.min() + LOW * height(skeleton)).tolist())


def _swing(before: Floats, after: Floats) -> Floats:
    """Return the least rotation that takes one direction (3,) to another."""
    a, b = (each / np.linalg.norm(each) for each in (before, after))
    axis, cosine = np.cross(a, b), float(a @ b)
    if cosine < -1 + 1e-9:
        axis = np.cross(a, np.eye(3)[np.abs(a).argmin()])
        axis /= np.linalg.norm(axis)
        return 2 * np.outer(axis, axis) - np.eye(3)
    cross = np.cross(np.eye(3), axis)
    return np.eye(3) + cross + cross @ cross / (1 + cosine)


def fitted_binds(own: Skeleton, posed: PosedAlike, images: Ints) -> Floats:
    """Return where the own joints are bound on another character that is posed alike, shape (J, 4, 4)."""
    binds = np.array(own.bind_transforms)
    for joint, owner in enumerate(owners(own, images).tolist()):
        binds[joint, :3, 3] = posed.transforms[images[owner], :3, 3]
        if joint != owner:  # as far from it as it was
            binds[joint, :3, 3] += own.bind_transforms[joint, :3, 3] - own.bind_transforms[owner, :3, 3]
    return binds


def carrying(own: Skeleton, other: Character, images: Ints, posed: PosedAlike) -> Character:
    """Return another character on which a network sees the own joints; its hub stands for the own one.

    Its bind pose is turned as a whole, so that its trunk is bound as it is when posed alike. Neither joints nor skin
    move differently for it.
    """
    carriers, binds = images[owners(own, images)], fitted_binds(own, posed, images)
    rest = local_transforms(binds, own.parents)
    at = other.skeleton.bind_transforms[images[own.hub], :3, 3]
    turn = rigid(posed.upright, at - posed.upright @ at)
    seen = SeenJoints(
        replace(own, bind_transforms=binds, rest_transforms=rest, placement=None),
        carriers, invert_rigid(posed.transforms[carriers]) @ binds, turn,
    )  # fmt: skip
    character = turned(other, turn)
    return replace(character, skeleton=replace(character.skeleton, hub=int(images[own.hub]), seen=seen))


def turned(character: Character, turn: Floats) -> Character:
    """Return a character whose bind pose is turned as a whole by a rigid transform (4, 4)."""
    if np.array_equal(turn, np.eye(4)):
        return character

    def moved(body: Body) -> Body:
        return replace(body, mesh=replace(body.mesh, points=body.mesh.points @ turn[:3, :3].T + turn[:3, 3]))

    return replace(
        character,
        skeleton=replace(character.skeleton, bind_transforms=turn @ character.skeleton.bind_transforms),
        bodies=tuple(map(moved, character.bodies)),
        stand_ins=tuple(map(moved, character.stand_ins)),
    )


def shaped_as_in_stage(character: Character, read: Callable[[Character], Motion]) -> Motion:
    """Return what `read` makes of a motion for a character as its stage has it, with its shapes in the character's
    bind pose."""
    seen = character.skeleton.seen
    if seen is None or np.array_equal(seen.turn, np.eye(4)):
        return read(character)
    motion, turn = read(turned(character, invert_rigid(seen.turn))), seen.turn[:3, :3]
    return replace(motion, shapes=tuple(replace(shape, offsets=shape.offsets @ turn.T) for shape in motion.shapes))


def body_alike(character: Character, posed: PosedAlike) -> Body:
    """Return a character's merged body in the pose of `alike`."""
    body = character.merged_body()
    moves = posed.transforms @ invert_rigid(character.skeleton.bind_transforms)
    return replace(body, mesh=replace(body.mesh, points=skin_points(body.mesh.points, body.skin, moves[None])[0]))


def unposed(points: Floats, skin: SkinWeights, posed: PosedAlike, skeleton: Skeleton) -> Floats:
    """Return where points (V, 3) of a pose are in the bind pose, by linear blend skinning, shape (V, 3)."""
    return (np.linalg.inv(blended(skin, posed, skeleton)) @ _homogeneous(points)[..., None])[:, :3, 0]


def posed_points(points: Floats, skin: SkinWeights, posed: PosedAlike, skeleton: Skeleton) -> Floats:
    """Invert `unposed`."""
    return (blended(skin, posed, skeleton) @ _homogeneous(points)[..., None])[:, :3, 0]


def blended(skin: SkinWeights, posed: PosedAlike, skeleton: Skeleton) -> Floats:
    """Return the transforms (V, 4, 4) by which linear blend skinning takes points to the pose."""
    moves = posed.transforms @ invert_rigid(skeleton.bind_transforms)
    return np.einsum("vi,viab->vab", skin.weights, moves[skin.indices])


def _homogeneous(points: Floats) -> Floats:
    return np.concatenate([points, np.ones((len(points), 1))], axis=1)


def moved_proxies(rig: ProxyRig, cloth: Floats, moves: Floats) -> Floats:
    """Return bind transforms of proxies (P, 4, 4) that move with the vertices that they lie at; both (V, 3)."""
    binds = np.array(rig.bind_transforms)
    if len(binds):
        at = np.linalg.norm(binds[:, None, :3, 3] - cloth[None], axis=-1).argmin(axis=1)
        binds[:, :3, 3] += moves[at]
    return binds
