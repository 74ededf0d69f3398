# SPDX-License-Identifier: Apache-2.0
"""How garments of a shot lie over one another, as a page tells it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

from ...physics.intersections.figures import EVERY, LAYERS, LayerFigures
from ...physics.intersections.layers import ClothLayers, LayerCounts
from ...scene.assets import Floats, Mesh
from .page import Section, table

TITLE = "Garments over one another"


class LayersMeter:
    """Counts in every `EVERY`-th frame, for each pair of garments.

    Files do not say which one is the outer: it is the one that covers more of the other in the bind pose.

    Args:
        garments: at rest, by their index in the player, with their names.
        body: of the character at rest, or None.
    """

    def __init__(self, garments: Mapping[int, tuple[str, Mesh]], body: Mesh | None) -> None:
        self._pairs: list[tuple[tuple[int, int], ClothLayers, list[LayerCounts]]] = []
        self._frame = 0
        for pair in combinations(garments, 2):
            layers = ClothLayers.by_cover(garments[pair[0]], garments[pair[1]], body)
            way = pair if layers.outer is garments[pair[0]][1] else pair[::-1]
            self._pairs.append((way, layers, []))

    def add(self, points: Sequence[Floats], number: float) -> None:
        """Count in the next frame, from the points of all meshes; `number` is that of the frame."""
        if self._frame % EVERY == 0:
            for (outer, inner), layers, counts in self._pairs:
                counts.append(layers.counts([points[outer]], [points[inner]], [number]))
        self._frame += 1

    def figures(self, clip: str) -> list[LayerFigures]:
        """Return the figures of each pair."""
        return [layers.figures([(clip, each) for each in counts]) for _, layers, counts in self._pairs]


def layers_section(figures: Sequence[LayerFigures]) -> Section:
    """Return the section about pairs of garments."""
    head = ("", "triangles that intersect", "in the worst frame", "inner cloth that shows", "at most")
    rows = [
        [
            f"{each.outer} over {each.inner}",
            f"{each.mean:.3%}",
            f"{each.worst:.2%}, frame {each.frame:g}",
            "–" if each.shown is None else f"{each.shown:.3%}",
            "–" if each.worst_shown is None else f"{each.worst_shown:.2%}",
        ]
        for each in figures
    ]
    told: dict[str, list[dict[str, object]]] = {}
    for each in figures:
        told.setdefault(each.outer, []).append(each.to_metadata())
    return Section(TITLE, table(head, rows), {LAYERS: told})
