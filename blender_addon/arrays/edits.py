# SPDX-License-Identifier: GPL-3.0-or-later
"""Changes that an artist made to proxies by hand, and how a newly generated rig keeps them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Edits:
    """Changes since proxies were generated, in Blender's world.

    Attributes:
        changed: where each proxy that was moved or reparented had been generated, by its name now, each (3,).
        added: names of proxies that were not generated.
        deleted: where those had been generated that are gone, shape (D, 3).
        repainted: which vertices have other weights, shape (V,).
    """

    changed: dict[str, np.ndarray]
    added: tuple[str, ...]
    deleted: np.ndarray
    repainted: np.ndarray

    @classmethod
    def none(cls, vertex_count: int) -> Edits:
        """Return that nothing was changed."""
        return cls({}, (), np.zeros((0, 3)), np.zeros(vertex_count, dtype=bool))

    @property
    def kept(self) -> tuple[str, ...]:
        """The bones that are the artist's."""
        return (*self.changed, *self.added)

    @property
    def summary(self) -> str:
        """What was changed, in words; empty if nothing was."""
        counts = {
            "moved": len(self.changed), "added": len(self.added), "deleted": len(self.deleted),
            "vertices repainted": int(self.repainted.sum()),
        }  # fmt: skip
        return ", ".join(f"{count} {what}" for what, count in counts.items() if count)


def match_proxies(places: np.ndarray, edits: Edits) -> list[str | None]:
    """Return which bone takes the place of each proxy of a new rig: a name, "" for a new bone, None for no bone.

    Bones that were moved take the place of the new proxy nearest to where they had been generated, and proxies near
    one that was deleted are not made again; nearer than half the spacing of the rig.

    Args:
        places: of the new proxies in Blender's world, shape (P, 3).
    """
    found: list[str | None] = [""] * len(places)
    claims = [*((place, name) for name, place in edits.changed.items()), *((place, None) for place in edits.deleted)]
    for place, taker in claims:
        away = np.linalg.norm(places - place, axis=1)
        away[[proxy for proxy, taken in enumerate(found) if taken != ""]] = np.inf
        if len(away) and away.min() <= spacing(places) / 2:
            found[int(away.argmin())] = taker
    return found


def spacing(places: np.ndarray) -> float:
    """Return the mean distance of places (P, 3) to their nearest neighbour; infinite for fewer than two."""
    if len(places) < 2:
        return np.inf
    away = np.linalg.norm(places[:, None] - places, axis=-1)
    np.fill_diagonal(away, np.inf)
    return float(away.min(axis=1).mean())
