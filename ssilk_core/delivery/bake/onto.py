# SPDX-License-Identifier: Apache-2.0
"""A model on a character with another skeleton, onto which 'ssilk rig --onto' has put its garment.

The network sees its own joints, carried by those that stand for them (`scene.posed_alike`), and all else is the
other character's. The garment is brought from the pose in which the model is bound into the character's bind pose, by
its trained weights: its points, its blendshapes, and its proxies with the joints that they hang from. Where a vertex
follows joints that are bound alike, it then moves as on the model's own character, and where joints are bound
otherwise, as skinning blends them. What proxies turn is not brought along, so that they have to hang from joints that
are bound nearly as the model's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ...errors import fail
from ...events import Event, Message, format_count
from ...files import split_location
from ...network.checkpoint import ModelFile
from ...network.runtime.deformer import deformer
from ...scene.assets import PINNED, Character, Floats, Garment, Ints, Scene, Skeleton, SkinWeights
from ...scene.family import BodyFamily
from ...scene.joint_map import OTHER_SIZE, JointMap, leaf, short_names, size_ratio, weights_left
from ...scene.kinematics import invert_rigid
from ...scene.posed_alike import (
    TURNED,
    PosedAlike,
    alike,
    blended,
    carrying,
    fitted_binds,
    moved_proxies,
    posed_points,
    rotation_angles,
    unposed,
)

if TYPE_CHECKING:
    from pxr import Usd
    from ssilk_usd.reading.stand_ins import PutOn

PROXIES_TURNED = 12.0  # [degrees] by which joints with proxies may be bound otherwise
IN_BIND_POSE = ("decoder.shapes", "decoder.offset")  # parameters that are displacements in the bind pose
FEW = 0.5  # of the model's joints, of which less is a warning


@dataclass(frozen=True, eq=False)
class PutOnModel:
    """A model on a character with another skeleton.

    Attributes:
        file: as a model for that character.
        told: what there is to say of it.
        identity: what tells the character from others.
    """

    file: ModelFile
    told: tuple[Event, ...]
    identity: tuple[float, ...]


def put_onto(file: ModelFile, stage: Usd.Stage, character: Character) -> PutOnModel | None:
    """Return a model on a character with another skeleton; None where its garment was not put onto it.

    Raises:
        SsilkError: it was put on from another character or mesh, or the map of joints is not sound.
    """
    from ssilk_usd.reading.stand_ins import read_put_on

    prim = split_location(character.skeleton.path)[1]
    there = read_put_on(stage, character.skeleton, prim or "")
    put = _chosen(file, there, character) if there else None
    if put is None:
        return None
    own, other = file.scene.character.skeleton, character.skeleton
    images = _images(file, put, other)
    posed = alike(own, other, images)
    binds = fitted_binds(own, posed, images)
    coordinates = None
    if file.bodies is not None:
        coordinates = _nearest_body(file.bodies.family.bodies, binds[:, :3, 3], np.flatnonzero(images >= 0))
        file = file.on_body(coordinates)
    assert put.garment.skin is not None
    points = posed_points(put.garment.mesh.points, put.garment.skin, posed, other)
    stands = carrying(own, character, images, posed)
    told = tuple(_told(file, character, images, posed, coordinates))
    identity = tuple((np.round(binds[:, :3, 3].reshape(-1), 6) + 0.0).tolist())
    return PutOnModel(_bound(file, put.garment, stands, posed, points), told, identity)


def _chosen(file: ModelFile, there: Sequence[PutOn], character: Character) -> PutOn | None:
    """Return the garment of a stage that is the model's; None where the character may have the model's joints itself.

    Raises:
        SsilkError: it is none of them.
    """
    from ssilk_usd.reading.skin import match_joints

    own, skeleton = file.scene.garment.mesh, file.scene.character.skeleton
    same = [
        each
        for each in there
        if each.garment.mesh.vertex_count == own.vertex_count
        and np.array_equal(each.garment.mesh.faces, own.faces)
        and set(skeleton.joint_names).issubset(each.stands_for)
    ]
    if len(same) > 1:
        leaf = own.path.rpartition("/")[2]
        same = [each for each in same if each.garment.mesh.path.rpartition("/")[2] == leaf]
    if not same and min(match_joints(skeleton.joint_names, character.skeleton.joint_names)) >= 0:
        return None
    if len(same) != 1:
        listed = ", ".join(f"{each.garment.mesh.path} of {each.garment.mesh.vertex_count} points" for each in there)
        allowed = (
            f"one of the model's {own.vertex_count} points, from the character that it was trained on, is needed"
        )
        fail(character.path, f"garments that were put onto it are {listed}", allowed, "run 'ssilk rig --onto' for it")
    if same[0].garment.skin is None:
        fail(same[0].garment.mesh.path, "it has no weights", "'ssilk rig --onto' writes some", "run it again")
    return same[0]


def _images(file: ModelFile, put: PutOn, other: Skeleton) -> Ints:
    own = file.scene.character.skeleton
    names = {name: put.stands_for[name] for name in own.joint_names}
    return JointMap(put.garment.mesh.path, names).images(own, other)


def _bound(file: ModelFile, lies: Garment, character: Character, posed: PosedAlike, points: Floats) -> ModelFile:
    """Return a model for a character, on which its garment lies at points (V, 3) in the pose of the model's bind."""
    own, skeleton = file.scene, character.skeleton
    assert skeleton.seen is not None
    carriers = skeleton.seen.carriers
    movers = np.concatenate([carriers, skeleton.joint_count + np.arange(own.rig.proxy_count)])
    roots = _roots(own)
    limbs = posed.transforms @ invert_rigid(skeleton.bind_transforms)  # to the pose of the model's bind
    _need_alike(file, character, carriers[roots], limbs)

    def moved(skin: SkinWeights, joints: Ints) -> SkinWeights:
        return SkinWeights(skin.path, joints[skin.indices], skin.weights)

    trained = deformer(file).skin
    carried = moved(trained, np.concatenate([carriers, carriers[roots]]))
    lies_at = unposed(points, carried, posed, skeleton)
    mesh = replace(own.garment.mesh, path=lies.mesh.path, points=lies_at)
    garment = replace(
        own.garment, mesh=mesh, skin=moved(own.lbs_skin, movers), sewn=own.garment.sewn_mesh.points,
        colour=lies.colour, graded=False,  # brought into another bind pose, it is no shape that cloth rests in
    )  # fmt: skip
    binds = moved_proxies(own.rig, own.garment.mesh.points, points - own.garment.mesh.points)
    parents, paths = movers[own.rig.parents], [*skeleton.joint_names]
    for name, parent in zip(own.rig.joint_names, parents):
        paths.append(f"{paths[parent]}/{name.rpartition('/')[2]}")
    rig = replace(
        own.rig, joint_names=tuple(paths[skeleton.joint_count :]), parents=parents,
        bind_transforms=invert_rigid(limbs[carriers[roots]]) @ binds, skin=moved(own.rig.skin, movers),
    )  # fmt: skip
    back = np.linalg.inv(blended(carried, posed, skeleton)[own.classes != PINNED, :3, :3])
    parameters = {
        name: (np.einsum("vab,vb...->va...", back, values).astype(values.dtype) if name in IN_BIND_POSE else values)
        for name, values in file.parameters.items()
    }
    return replace(file, scene=Scene(character, garment, rig), parameters=parameters)


def _roots(scene: Scene) -> Ints:
    """Return the joint of the character that each proxy hangs from, by way of others or not, shape (P,)."""
    count, found = scene.character.skeleton.joint_count, list[int]()
    for parent in scene.rig.parents.tolist():
        found.append(parent if parent < count else found[parent - count])
    return np.array(found, dtype=np.int64)


def _need_alike(file: ModelFile, character: Character, roots: Ints, limbs: Floats) -> None:
    """Raise `SsilkError` where proxies hang from joints that are bound far from where the model has them."""
    if not len(roots):
        return
    angles = rotation_angles(limbs[roots, :3, :3])
    worst = int(angles.argmax())
    if angles[worst] > PROXIES_TURNED:
        name = leaf(character.skeleton, int(roots[worst]))
        found = f"'{name}', from which proxies hang, is bound {angles[worst]:.0f} degrees from where the model has it"
        allowed = f"the model's proxies may be turned by {PROXIES_TURNED:.0f} degrees"
        fail(character.path, found, allowed, "bind that limb as the garment's character does, or train on this one")


def _nearest_body(family: BodyFamily, joints: Floats, known: Ints) -> Floats:
    """Return the coordinates (K,) of the body within a family whose joints are most like some (J, 3) [m], (N,) of
    which are known."""
    count = len(known)
    moves = family.joint_moves[:, known].reshape(family.size, -1)
    # Where the body stands is no part of its shape.
    anywhere = np.tile(np.eye(3), (1, count))
    wanted = (joints - family.joints)[known].reshape(-1)
    held = 1e-3 * np.eye(family.size + 3)[: family.size]  # joints alone may not tell all directions apart
    found = np.linalg.lstsq(
        np.concatenate([np.concatenate([moves, anywhere]).T, held]),
        np.concatenate([wanted, np.zeros(family.size)]),
        rcond=None,
    )[0][: family.size]
    return family.nearest(found)


def _told(
    file: ModelFile, character: Character, images: Ints, posed: PosedAlike, coordinates: Floats | None
) -> list[Event]:
    own, other = file.scene.character.skeleton, character.skeleton
    path, names, others = character.path, short_names(own), short_names(other)
    mapped = int(np.count_nonzero(images >= 0))
    text = f"{path}: joints of this character stand for {mapped} of the model's {format_count(len(images), 'joints')}"
    told: list[Event] = [Message(text, "warning" if mapped < FEW * len(images) else "info")]
    if coordinates is not None:
        place = ", ".join(f"{round(float(value), 3) + 0.0:.3f}" for value in coordinates)
        told.append(
            Message(f"{path}: the network sees the body of its family whose joints are most alike, ({place})")
        )
    turned = [joint for joint in images[images >= 0].tolist() if posed.turned[joint] > TURNED]
    if turned:
        most = max(turned, key=lambda joint: posed.turned[joint])
        found = f"{len(turned)} joints are bound up to {posed.turned[most]:.0f} degrees ('{others[most]}')"
        told.append(Message(f"{path}: {found} from where the model has them, which is taken into account"))
    if file.scene.garment.graded:
        text = "it was graded to bodies; the solver and figures count from its shape on the first of them here"
        told.append(Message(f"{path}: {text}", "warning"))
    left = weights_left(file.scene.lbs_skin, own, images)
    if left:
        listed = ", ".join(f"{names[joint]} ({share:.0%})" for joint, share in left[:3])
        told.append(Message(f"{path}: joints with weights that none stands for move with those above them: {listed}"))
    ratio = size_ratio(own, other, images)
    if abs(ratio - 1) > OTHER_SIZE:
        found = f"it is {abs(ratio - 1):.0%} {'taller' if ratio > 1 else 'smaller'} than the body of the training"
        told.append(Message(f"{path}: {found}; the network moves its garment as there", "warning"))
    return told
