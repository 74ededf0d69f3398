# SPDX-License-Identifier: Apache-2.0
"""Proxies that are held by themselves: to linear blend skinning, or to a pose that was made by hand.

A held proxy is placed in the world, whatever its parents do: it turns from where the network has it by the shorter
arc, and its origin moves on a line. Blendshapes fade with it, at each vertex by the proxies that it follows. UsdSkel
weighs a blendshape alike everywhere, so a garment that is held in part has its blendshapes again for each way in
which proxies are held over time, multiplied by how far vertices follow these proxies.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np

from .assets import Deformer, Floats, GarmentPose, Ints, Motion, Scene
from .kinematics import (
    combined_transforms,
    invert_rigid,
    local_transforms,
    matrix_from_quaternion,
    motion_transforms,
    quaternion_from_matrix,
    rigid,
    slerp,
)

ALIKE = 1e-4  # by which two curves may differ that count as one
STRAY = 0.05  # of a proxy's vertices that may be in a group, or lack in it, for the proxy to count as out or in


@dataclass(frozen=True, eq=False)
class HeldParts:
    """How the proxies of a garment are held over S samples.

    Attributes:
        skinned: 1 where linear blend skinning has a proxy, 0 where it is free, shape (S, P).
        posed: likewise 1 where it is as it was posed by hand, which comes over that, shape (S, P).
        hand: that pose, from the joints of the character that proxies hang from, shape (S, P, 4, 4).
    """

    skinned: Floats
    posed: Floats
    hand: Floats

    @property
    def free(self) -> Floats:
        """What is left to the network of each proxy, shape (S, P)."""
        return (1 - self.skinned) * (1 - self.posed)

    def of(self, change: Callable[[Floats], Floats]) -> HeldParts:
        """Return them with each array changed alike."""
        return replace(self, **{each.name: change(getattr(self, each.name)) for each in fields(self)})


def anchors(scene: Scene) -> Ints:
    """Return the joint of the character that each proxy hangs from, over other proxies, shape (P,)."""
    count, found = scene.character.skeleton.joint_count, list[int]()
    for parent in scene.rig.parents.tolist():
        found.append(parent if parent < count else found[parent - count])
    return np.array(found, dtype=np.int64)


def hand_pose(scene: Scene, whole: Motion) -> Floats:
    """Return where a motion of all joints, proxies last, has proxies, as `HeldParts.hand`."""
    count = scene.character.skeleton.joint_count
    world = motion_transforms(whole, scene.parents)
    return invert_rigid(world[:, anchors(scene)]) @ world[:, count:]


def shares_of_group(deformer: Deformer, vertices: Ints) -> Floats:
    """Return how far each proxy belongs to a group of vertices, by the vertices that follow it, shape (P,)."""
    follow = _followers(deformer)
    total = follow.sum(axis=0)
    share = follow[vertices].sum(axis=0) / np.maximum(total, 1e-9)
    return np.where(share < STRAY, 0, np.where(share > 1 - STRAY, 1, share))


def _followers(deformer: Deformer) -> Floats:
    """Return the weights of proxies at vertices, shape (V, P)."""
    scene = deformer.scene
    return deformer.skin.dense(len(scene.joint_names))[:, scene.character.skeleton.joint_count :]


def shares_of_proxies(deformer: Deformer) -> Floats:
    """Return what proxies count at vertices, of all that these follow, shape (V, P); alike where they follow none."""
    follow = _followers(deformer)
    total = follow.sum(axis=1, keepdims=True)
    return np.where(total > 0, follow / np.maximum(total, 1e-9), 1 / max(follow.shape[1], 1))


@dataclass(frozen=True, eq=False)
class PartShapes:
    """The blendshapes that a garment has besides its own K, of which the last is constant, where parts are held.

    Attributes:
        offsets: each of the K - 1 for each of R curves, then a constant one, shape (R (K - 1) + 1, V, 3).
        curves: what vertices that follow these have more of the network's weights than all have, shape (S, R).
    """

    offsets: Floats
    curves: Floats

    @classmethod
    def of(cls, deformer: Deformer, free: Floats, whole: Floats) -> PartShapes:
        """Return those of a garment of which proxies are free by (S, P), and all else by (S,)."""
        curves, shares = _independent(free - whole[:, None])
        masks = (shares_of_proxies(deformer) @ shares.T).T.astype(np.float32)
        # A weight lies in [0, 1]: that of no change is in the middle, and the constant shape takes the middle back.
        parts = 2 * masks[:, None, :, None] * deformer.shapes[None, :-1]
        parts = parts.reshape(-1, *deformer.shapes.shape[1:])
        constant = -0.5 * parts.sum(axis=0, keepdims=True, dtype=np.float64)
        return cls(np.concatenate([parts, constant.astype(np.float32)]), curves)

    def weights(self, away: Floats, samples: Ints) -> Floats:
        """Return the weights of these shapes (F, R (K - 1) + 1) at samples (F,).

        Args:
            away: the network's weights less those of a garment that is held, shape (F, K).
        """
        moved = self.curves[samples][:, :, None] * away[:, None, :-1]
        own = (0.5 + 0.5 * moved).reshape(len(away), -1).clip(0, 1)
        return np.concatenate([own, np.ones((len(away), 1))], axis=1)


def _independent(curves: Floats) -> tuple[Floats, Floats]:
    """Return the fewest of curves (S, P) that make up all, shape (S, R), and how, shape (R, P)."""
    chosen, left = list[int](), curves.copy()
    while left.size and np.abs(left).max() > ALIKE:
        chosen.append(int(np.abs(left).max(axis=0).argmax()))
        basis = np.linalg.qr(curves[:, chosen])[0]
        left = curves - basis @ (basis.T @ curves)
    shares = np.linalg.lstsq(curves[:, chosen], curves, rcond=None)[0] if chosen else np.zeros((0, curves.shape[1]))
    return curves[:, chosen], shares


def placed_apart(
    deformer: Deformer, motion: Motion, held: GarmentPose, network: GarmentPose, parts: HeldParts
) -> tuple[Floats, Floats]:
    """Return local rotations (F, P, 4) and translations (F, P, 3) of proxies that are held each by itself.

    Args:
        motion: the character's, in the F frames.
        held, network: as linear blend skinning and the network have the garment, counted from zero.
        parts: over these frames.
    """
    count, parents = deformer.scene.character.skeleton.joint_count, deformer.scene.parents
    own, skinned = (combined_transforms(deformer, motion, pose) for pose in (network, held))
    by_hand = own[:, anchors(deformer.scene)] @ parts.hand
    placed = _between(_between(own[:, count:], skinned[:, count:], parts.skinned), by_hand, parts.posed)
    local = local_transforms(np.concatenate([own[:, :count], placed], axis=1), parents)[:, count:]
    return quaternion_from_matrix(local[..., :3, :3]), local[..., :3, 3]


def _between(start: Floats, end: Floats, share: Floats) -> Floats:
    """Return rigid transforms between others (F, P, 4, 4), of which the second have a share (F, P)."""
    turned = slerp(quaternion_from_matrix(start[..., :3, :3]), quaternion_from_matrix(end[..., :3, :3]), share)
    moved = start[..., :3, 3] + share[..., None] * (end[..., :3, 3] - start[..., :3, 3])
    return rigid(matrix_from_quaternion(turned), moved)
