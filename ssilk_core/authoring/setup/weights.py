# SPDX-License-Identifier: Apache-2.0
"""Transfer skinning weights from the body to a garment that has none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...errors import fail
from ...scene.assets import LOOSE, Character, Ints, Mesh, SkinWeights
from ...scene.mesh.topology import edges, smooth, vertex_areas, vertex_mask
from .binding import bind_to_skin
from .hosts import Hosts
from .surface import closest_on_surface


@dataclass(frozen=True)
class WeightOptions:
    """How body weights are transferred.

    Attributes:
        tight_rounds: rounds of averaging with the neighbours for all vertices.
        loose_rounds: total rounds for loose vertices, whose closest body points jump between limbs.
        influences: largest number of joints per vertex.
    """

    tight_rounds: int = 10
    loose_rounds: int = 75
    influences: int = 8

    def __post_init__(self) -> None:
        for name in ("tight_rounds", "loose_rounds"):
            if not getattr(self, name) >= 0:
                fail("weights", f"{name} = {getattr(self, name)}", "it must not be negative")
        if not self.influences > 0:
            fail("weights", f"influences = {self.influences}", "it must be positive")


def transfer_weights(
    character: Character, mesh: Mesh, *, classes: Ints | None = None, options: WeightOptions | None = None
) -> SkinWeights:
    """Take each vertex's weights from the closest point of the body's surface, then smooth them over the cloth.

    If `classes` are given, loose vertices are smoothed longer, and the weights of the others are fitted so that they
    stay over the skin beneath them (`bind_to_skin`). Vertices at the same position count as one, so that panels
    which meet without being welded stay together. Surfaces are matched regardless of their normals. Matching only
    those whose normals agree, and filling the gaps from their surroundings, changed the strain under motion at
    armpits and crotches by less than one percent.

    Islands that lie on others follow these (`Hosts.blend`).

    Args:
        mesh: the garment at the character's bind pose.
        classes: PINNED, TIGHT or LOOSE for each vertex, shape (V,).
    """
    options = options or WeightOptions()
    body = character.merged_body()
    _, first, place = np.unique(mesh.points.round(6), axis=0, return_index=True, return_inverse=True)
    place = place.reshape(-1)
    pairs = np.unique(np.sort(place[edges(mesh.faces)], axis=1), axis=0)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    closest = closest_on_surface(mesh.points[first], body.mesh)
    dense = body.skin.dense(character.skeleton.joint_count)
    copied = np.einsum("vk,vkj->vj", closest.barycentric, dense[closest.corners])
    weights = smooth(copied, pairs, options.tight_rounds)
    if classes is not None:
        loose = vertex_mask(place[np.asarray(classes) == LOOSE], len(first))
        areas = np.bincount(place, vertex_areas(mesh.points, mesh.faces)).astype(np.float64)
        held = np.flatnonzero(~loose)
        cloth = mesh.points[first[held]], areas[held], _among(pairs, held, len(first))
        if len(held):
            weights[held] = bind_to_skin(character, *cloth, (copied + weights)[held] / 2, options.influences)
        if loose.any():
            weights = smooth(weights, pairs, options.loose_rounds - options.tight_rounds, loose)
    movable = None if classes is None else np.asarray(classes) == LOOSE
    return SkinWeights.from_dense(mesh.path, Hosts.of(mesh).blend(weights[place], movable), options.influences)


def _among(pairs: Ints, chosen: Ints, count: int) -> Ints:
    """Return the pairs (E, 2) of which both are `chosen` out of `count`, as places among these."""
    place = np.full(count, -1)
    place[chosen] = np.arange(len(chosen))
    pairs = place[pairs]
    return pairs[(pairs >= 0).all(axis=1)]
