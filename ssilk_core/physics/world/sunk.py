# SPDX-License-Identifier: Apache-2.0
"""The share of a garment's vertices that lie inside colliders, counted over frames."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from ...scene.assets import Floats, ShotWorld
from .colliders import ColliderPoser, Nearby
from .surface import Search, boxes

DEPTH = 5e-3  # [m] inside a collider from which on a vertex counts: less is hidden by its own thickness
MOST_SUNK = 1e-3  # share of the vertices on average, which the eye finds
LISTED = 4  # colliders that figures name


@dataclass(frozen=True, kw_only=True)
class SunkCloth:
    """The share of a garment's vertices that lie more than `DEPTH` inside colliders, over frames.

    Attributes:
        frames: that were counted.
        mean, worst: mean share over frames, and that of the worst one.
        deepest: of a vertex inside [m].
        clip, frame: the worst frame, of several equal ones the first; it is told as that of `ShownSkin` is.
        colliders: share of what is inside, of all frames together, that is inside each, by its name, largest first.
    """

    frames: int
    mean: float
    worst: float
    deepest: float
    clip: str
    frame: float
    colliders: dict[str, float]

    @property
    def where(self) -> str:
        """The colliders in words; empty where nothing is inside."""
        return ", ".join(f"{path} {share:.0%}" for path, share in self.colliders.items())

    def summary(self, clock: str = "frame") -> dict[str, str]:
        """Return figures for people; `clock` is what `frame` counts. No frame is the worst where none is inside."""
        found = {"cloth inside colliders": f"{self.mean:.3%}, the mean of {self.frames} frames"}
        if not self.worst:
            return found
        depth = f"{1000 * self.deepest:.0f} mm deep at most"
        return {
            **found,
            "most inside colliders": f"{self.worst:.2%}, {self.clip} at {clock} {self.frame:g}; {depth}",
            **({"inside": self.where} if self.where else {}),
        }

    def to_metadata(self) -> dict[str, object]:
        """Return figures of four digits, as a shot stores them."""
        rounded = {name: float(f"{value:.4g}") for name, value in vars(self).items() if isinstance(value, float)}
        colliders = {path: round(share, 4) for path, share in self.colliders.items()}
        return {**vars(self), **rounded, "colliders": colliders}

    def __str__(self) -> str:
        most = f", {self.worst:.2%} in the worst frame ({self.clip}, frame {self.frame:g}); {self.where}"
        text = f"{self.mean:.3%} of the vertices are more than {1000 * DEPTH:g} mm inside colliders"
        return text + (most if self.worst else "")


class SunkCounter:
    """Counts the vertices of a garment inside the colliders of its shot, frame by frame.

    Args:
        search: finds nearest points on triangles.
    """

    def __init__(self, world: ShotWorld, search: Search = boxes) -> None:
        self._world, self._poser = world, ColliderPoser(search)
        self._shares: list[tuple[float, float]] = []
        self._deepest = 0.0
        self._inside: Counter[str] = Counter()

    def add(self, points: Floats, carried: Floats, seconds: float, frame: float) -> None:
        """Count in a frame.

        Args:
            points: of the garment in the world [m], shape (V, 3). What is not finite counts as inside.
            carried: vertices as the body carries them, by which a floor has its outside, shape (P, 3).
            seconds: since the world's first frame; frame: as it is told.
        """
        sound = np.isfinite(points).all(axis=1)
        inside, asked = ~sound, np.flatnonzero(sound)
        near = Nearby.of(points[asked], DEPTH) if len(asked) else None
        for collider in self._poser.at(self._world, seconds, np.zeros(3), carried, near) if near else ():
            rows, found = collider.near(points[asked], -DEPTH)
            inside[asked[rows]] = True
            self._inside[collider.name] += len(rows)
            self._deepest = max(self._deepest, float(-found.distance.min(initial=0.0)))
        self._shares.append((float(inside.mean()), frame))

    def figures(self, clip: str) -> SunkCloth:
        """Return what was counted in the frames of a clip, of which there is one at least."""
        shares = np.array([share for share, _ in self._shares])
        worst, frame = self._shares[int(shares.argmax())]
        total = sum(self._inside.values())
        most = {path: count / total for path, count in self._inside.most_common(LISTED) if count}
        return SunkCloth(
            frames=len(shares), mean=float(shares.mean()), worst=worst, deepest=self._deepest, clip=clip,
            frame=frame, colliders=most,
        )  # fmt: skip
