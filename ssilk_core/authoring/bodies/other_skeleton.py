# SPDX-License-Identifier: Apache-2.0
"""Put a garment onto a character with another skeleton and another body, by a map of joints.

The other character is posed as the garment's own is bound (`scene.posed_alike`). The own body's mesh is laid onto
its surface there, and the garment moves with it as on a body of its family (`carry`), then out of the other body.
Weights go to the joints that stand for those that had them. Where several joints of the other character move what one
did, such as a longer spine or twist joints, they share its weight as they do in the skin beneath. The garment is then
brought from that pose into the other character's own bind pose, with these weights. Classes stay, and proxies hang
from the joints that stand for theirs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...events import Message, Reporter
from ...scene.assets import Body, Character, Floats, Ints, Mesh, ProxyRig, Scene, Skeleton, SkinWeights
from ...scene.joint_map import leaf, owners
from ...scene.kinematics import invert_rigid
from ...scene.posed_alike import TURNED, PosedAlike, alike, body_alike, fitted_binds, moved_proxies, unposed
from ..preflight.fit import describe_left, describe_move
from ..preflight.settle import Settled, settle
from .carry import carried_moves
from .fitted import fitted_body

NEAREST = 8  # points of skin that tell which joints move cloth
SHARED = 0.2  # of the weights beneath, from which on joints share all of a weight as they do there
LOOSE_FIT = 20.0  # [mm] from which on the bodies are told to be unlike
LEAST = 0.01  # weights below this are left out


@dataclass(frozen=True, eq=False)
class CarriedOnto:
    """A garment on a character with another skeleton.

    Attributes:
        scene: that character with the garment and its proxies, in its bind pose.
        images: the joint that stands for each of the garment's own, or -1, shape (J,).
        posed: that character as the own one is bound; body, unsettled, settled: its body, the garment on it before it
            was settled, and how it was.
        moved: how far the garment's vertices moved between the two bodies [m], shape (V, 3).
        fit: distances of the own body's points, laid onto the other body, from its surface [m], shape (B,).
    """

    scene: Scene
    images: Ints
    posed: PosedAlike
    body: Body
    unsettled: Mesh
    settled: Settled
    moved: Floats
    fit: Floats


def carry_onto(scene: Scene, other: Character, images: Ints) -> CarriedOnto:
    """Carry the garment of a scene onto a character with another skeleton.

    Args:
        images: the joint of the other character that stands for each of the own ones, or -1, shape (J,).

    Raises:
        SsilkError: the other character is bound in a pose that cannot be made out.
    """
    own = scene.character.skeleton
    posed = alike(own, other.skeleton, images)
    theirs, base, cloth = body_alike(other, posed), scene.character.merged_body(), scene.garment.mesh
    fitted = fitted_body(base, own, fitted_binds(own, posed, images), theirs.mesh)
    moves = carried_moves(cloth, scene.lbs_skin, base, fitted, own.joint_count)
    unsettled = replace(cloth, points=cloth.points + moves)
    settled = settle(unsettled, theirs.mesh)
    there = unsettled.points + settled.offsets
    shares = _Shares(own, other.skeleton, images, theirs, there)
    skin = shares.of(scene.lbs_skin, 0)
    points = unposed(there, skin, posed, other.skeleton)
    garment = replace(scene.garment, mesh=replace(cloth, points=points), skin=skin)
    rig = _rig_onto(scene, other.skeleton, images, posed, there, shares)
    return CarriedOnto(
        Scene(other, garment, rig), images, posed, theirs, unsettled, settled, there - cloth.points,
        _distances(fitted.mesh.points, theirs.mesh),
    )  # fmt: skip


def tell_carried(carried: CarriedOnto, scene: Scene, report: Reporter) -> None:
    """Say how far a garment moved onto a character with another skeleton, and how well that body could be told."""
    path, there = scene.garment.mesh.path, carried.scene.character.path
    moved, fit = np.linalg.norm(carried.moved, axis=1), 1000 * carried.fit
    text = f"carried onto {there}, by {1000 * moved.mean():.0f} mm on average and {1000 * moved.max():.0f} mm at most"
    report(Message(f"{path}: {text}"))
    worst = float(np.percentile(fit, 95))
    text = (
        f"{there}: the skin of {scene.character.path} lies on this body within {worst:.0f} mm at 95 % of its points"
    )
    report(Message(text, "warning" if worst > LOOSE_FIT else "info"))
    joint = int(carried.posed.turned.argmax())
    if carried.posed.turned[joint] > TURNED:
        name, angle = leaf(carried.scene.character.skeleton, joint), carried.posed.turned[joint]
        text = f"'{name}' was turned by {angle:.0f} degrees into the pose of the garment, and back"
        report(Message(f"{there}: {text}"))
    if carried.settled.moved:
        report(Message(f"{path}: settling it there {describe_move(carried.settled, 'moves')}"))
    other = replace(carried.scene.character, bodies=(carried.body,))
    if left := describe_left(carried.settled, carried.unsettled, other):
        report(Message(f"{path}: {left}", "warning"))


class _Shares:
    """Which joints of another character take the weights of each of the garment's own at each vertex of cloth.

    Args:
        body: of the other character; points: of the cloth beside it, shape (V, 3).
    """

    def __init__(self, own: Skeleton, other: Skeleton, images: Ints, body: Body, points: Floats) -> None:
        from scipy.spatial import cKDTree

        self.takes = images[owners(own, images)]  # the joint that takes the weight of each own one
        stands = np.full(other.joint_count, -1)
        stands[images[images >= 0]] = 0
        self.owners = owners(other, stands)
        away, at = cKDTree(body.mesh.points).query(points, k=min(NEAREST, len(body.mesh.points)))
        near = 1 / (away.reshape(len(points), -1) + 1e-4)
        near /= near.sum(axis=1, keepdims=True)
        dense, at = body.skin.dense(other.joint_count), at.reshape(len(points), -1)
        self.beneath = np.zeros((len(points), other.joint_count))
        for share, rows in zip(near.T, at.T):
            self.beneath += share[:, None] * dense[rows]

    def of(self, skin: SkinWeights, proxies: int) -> SkinWeights:
        """Return weights over the own joints, then so many proxies, as weights over the other's, then these."""
        count, joints = len(self.takes), self.beneath.shape[1]
        dense = skin.dense(count + proxies)
        found = np.zeros((len(dense), joints + proxies))
        found[:, joints:] = dense[:, count:]
        for joint in np.flatnonzero(dense[:, :count].any(axis=0)).tolist():
            taker = int(self.takes[joint])
            group = np.flatnonzero(self.owners == taker)
            beneath = self.beneath[:, group]
            total = beneath.sum(axis=1, keepdims=True)
            part = dense[:, joint, None]
            sure = (total / SHARED).clip(max=1)
            found[:, group] += part * sure * beneath / total.clip(min=1e-9)
            found[:, taker] += (part * (1 - sure))[:, 0]
        kept = np.where(found < LEAST, 0.0, found)
        return SkinWeights.from_dense(skin.path, kept / kept.sum(axis=1, keepdims=True))


def _rig_onto(
    scene: Scene, other: Skeleton, images: Ints, posed: PosedAlike, there: Floats, shares: _Shares
) -> ProxyRig:
    rig, own = scene.rig, scene.character.skeleton
    if not rig.proxy_count:
        return replace(rig, skin=shares.of(rig.skin, 0))
    count, cloth = own.joint_count, scene.garment.mesh
    parents = np.where(rig.parents < count, shares.takes[rig.parents.clip(max=count - 1)],
                       rig.parents - count + other.joint_count)  # fmt: skip
    binds = moved_proxies(rig, cloth.points, there - cloth.points)
    back = other.bind_transforms @ invert_rigid(posed.transforms)
    for proxy, parent in enumerate(parents.tolist()):
        above = parent
        while above >= other.joint_count:
            above = int(parents[above - other.joint_count])
        binds[proxy] = back[above] @ binds[proxy]
    return replace(rig, parents=parents, bind_transforms=binds, skin=shares.of(rig.skin, rig.proxy_count))


def _distances(points: Floats, mesh: Mesh) -> Floats:
    import igl

    square = igl.point_mesh_squared_distance(points, mesh.points, mesh.faces.astype(np.int64))[0]
    return np.sqrt(np.asarray(square).reshape(-1))
