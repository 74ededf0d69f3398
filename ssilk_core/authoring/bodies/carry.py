# SPDX-License-Identifier: Apache-2.0
"""Carry a garment from the body that it was fitted to onto another body of the same family.

Every vertex moves as the skin about it does. For each, the similarity transform (a rotation, a scale, a displacement)
that best takes the skin of one body to the other is fitted anew, by moving least squares (Schaefer 2006). Skin
counts as 1 / (d^2 + n^2 + 2 e^2)^2 at the distance d, with the distance n of the nearest and the mean length e of
edges. Cloth on skin follows what is right beneath it, and cloth far away the body at large. Skin counts more where
the joints that move it move the cloth too: a sleeve beside the waist follows its arm. The cloth is then settled out
of the new body.

A body that is scaled, moved and turned as a whole takes its garment along exactly, and the same body leaves it
exactly as it is. Weights and classes stay. Proxies move with the vertices that they lie at.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...scene.assets import Body, Character, Floats, Mesh, Scene, SkinWeights
from ...scene.family import BodyFamily, DressedFamily
from ...scene.mesh.topology import edges, vertex_areas
from ..preflight.settle import PartInside, Settled, settle

OTHERS = 0.05  # how much skin counts that other joints move
AT_ONCE = 1 << 22  # pairs of cloth and skin


@dataclass(frozen=True, eq=False)
class Carried:
    """A garment on another body.

    Attributes:
        scene: the other character with the garment and its proxies.
        unsettled: the garment before it was settled out of the body.
        settled: how it was.
    """

    scene: Scene
    unsettled: Mesh
    settled: Settled


def carry(scene: Scene, other: Character) -> Carried:
    """Carry the garment of a scene onto another character of its family (`differences.differences` finds none)."""
    base, body, cloth = scene.character.merged_body(), other.merged_body(), scene.garment.mesh
    moves = carried_moves(cloth, scene.lbs_skin, base, body, scene.character.skeleton.joint_count)
    mesh = replace(cloth, points=cloth.points + moves)
    settled = settle(mesh, body.mesh) if moves.any() else _unmoved(mesh)
    moves = moves + settled.offsets
    binds = np.array(scene.rig.bind_transforms)
    if len(binds):
        at = np.linalg.norm(binds[:, None, :3, 3] - cloth.points[None], axis=-1).argmin(axis=1)
        binds[:, :3, 3] += moves[at]
    garment = replace(scene.garment, mesh=replace(cloth, points=cloth.points + moves))
    return Carried(Scene(other, garment, replace(scene.rig, bind_transforms=binds)), mesh, settled)


def carried_moves(cloth: Mesh, skin: SkinWeights, base: Body, other: Body, joints: int) -> Floats:
    """Return how far the vertices of cloth move from one body to another, before it is settled [m], shape (V, 3)."""
    places, moved = base.mesh.points, other.mesh.points - base.mesh.points
    if not moved.any():
        return np.zeros_like(cloth.points)
    pairs = edges(base.mesh.faces)
    near = float(np.linalg.norm(places[pairs[:, 0]] - places[pairs[:, 1]], axis=1).mean())
    areas, of_skin = vertex_areas(places, base.mesh.faces), base.skin.dense(joints)
    of_cloth, found = skin.dense(joints), np.zeros_like(cloth.points)
    count = max(1, AT_ONCE // len(places))
    for start in range(0, len(found), count):
        rows = slice(start, start + count)
        at = cloth.points[rows]
        away = np.square(at).sum(axis=1)[:, None] + np.square(places).sum(axis=1) - 2 * at @ places.T
        alike = OTHERS + (1 - OTHERS) * of_cloth[rows] @ of_skin.T
        away = away.clip(min=0) + near**2
        found[rows] = _similar_moves(at, places, moved, areas * alike / (away + away.min(axis=1)[:, None]) ** 2)
    return found


def _similar_moves(at: Floats, places: Floats, moved: Floats, weights: Floats) -> Floats:
    """Return how far points (N, 3) are moved by the similarity transforms that fit moved places best.

    Args:
        places, moved: of the skin, and how far it moves, shape (S, 3).
        weights: of the skin for each point, shape (N, S).
    """
    weights = weights / weights.sum(axis=1, keepdims=True)
    middle, shift = weights @ places, weights @ moved
    # Second moments about the weighted middles: of places with places, and of places with their moves.
    own, cross = ((weights @ (places[:, :, None] * each[:, None]).reshape(-1, 9)).reshape(-1, 3, 3)
                  for each in (places, moved))  # fmt: skip
    own, cross = (each - middle[:, :, None] * mean[:, None] for each, mean in ((own, middle), (cross, shift)))
    left, values, right = np.linalg.svd(own + cross)
    mirrored = np.linalg.det(left @ right) < 0
    values[mirrored, 2] *= -1
    right = np.where(mirrored[:, None, None] & (np.arange(3) == 2)[None, :, None], -right, right)
    scale = values.sum(axis=1) / np.trace(own, axis1=1, axis2=2)
    turned = scale[:, None, None] * (left @ right)
    return shift + np.einsum("na,nab->nb", at - middle, turned - np.eye(3))


def _unmoved(mesh: Mesh) -> Settled:
    none = PartInside(np.zeros(0, dtype=np.int64), 0.0)
    return Settled(np.zeros_like(mesh.points), none, none)


def dressed_family(
    scene: Scene, family: BodyFamily, others: Sequence[Character]
) -> tuple[DressedFamily, list[Carried]]:
    """Carry a garment onto all members of a family but the base, and return it on the family.

    Args:
        scene: the garment on the base.
        others: the other members, in the family's order.
    """
    carried = [carry(scene, other) for other in others]
    return DressedFamily.of(family, [scene, *(each.scene for each in carried)]), carried
