# SPDX-License-Identifier: Apache-2.0
"""The share of triangles that intersect others of the same garment, as figures; `intersections.cloth` counts it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import numpy as np

from ...scene.assets import Floats

EVERY = 4  # of so many frames one is counted, as libigl takes some 30 ms for one; cloth hardly crosses itself in less
LIBIGL = "2.6.3"  # the first version with the predicates that find what intersects

INTERSECTION = "intersection"  # the term of contours in a training that has their weight
SHARE = "triangles that intersect others"
LAYERS = "layers"  # what is told of garments over others, under this name
NOT_COUNTED = f"not counted, as libigl {LIBIGL} or newer was missing"  # in place of figures


class SharesOfFrames(Protocol):
    """Shares of a garment's triangles in frames of one clip, and the numbers of these frames in it, both (N,)."""

    @property
    def shares(self) -> Floats: ...

    @property
    def frames(self) -> Floats: ...


Own = TypeVar("Own", bound="TriangleShares")


@dataclass(frozen=True, kw_only=True)
class TriangleShares:
    """The share of a garment's triangles that intersect others, over frames.

    Attributes:
        frames: that were counted: of each clip, or part without cuts, the first and every `EVERY`-th after it; of a
            validation in training a few, spread evenly over all clips.
        triangles: of the garment.
        mean, worst: mean share over these frames, and that of the worst one.
        clip, frame: the worst frame, of several equal ones the first; it is told as that of `ShownSkin` is.
    """

    frames: int
    triangles: int
    mean: float
    worst: float
    clip: str
    frame: float

    @classmethod
    def over(cls: type[Own], clips: Sequence[tuple[str, SharesOfFrames]], triangles: int, **own: Any) -> Own:
        """Return the figures of clips by name, with what else they have.

        Raises:
            ValueError: there is no frame.
        """
        together = np.concatenate([counts.shares for _, counts in clips])
        clip, worst = max(clips, key=lambda each: each[1].shares.max(initial=-1.0))
        return cls(
            frames=len(together),
            triangles=triangles,
            mean=float(together.mean()),
            worst=float(worst.shares.max()),
            clip=clip,
            frame=float(worst.frames[worst.shares.argmax()]),
            **own,
        )

    def to_metadata(self) -> dict[str, object]:
        """Return figures of four digits, as a shot stores them, without those that are None."""
        known = {name: value for name, value in vars(self).items() if value is not None}
        return {name: float(f"{value:.4g}") if isinstance(value, float) else value for name, value in known.items()}


@dataclass(frozen=True, kw_only=True)
class SelfIntersections(TriangleShares):
    """The share of a garment's triangles that intersect others of it, over frames.

    Attributes:
        regions: share of what intersects, of all frames together, at the joints that carry most of it in the
            garment's linear blend skinning, largest first.
    """

    regions: dict[str, float]

    @property
    def where(self) -> str:
        """The regions in words; empty where nothing intersects."""
        return ", ".join(f"{joint} {share:.0%}" for joint, share in self.regions.items())

    def summary(self, clock: str = "frame") -> dict[str, str]:
        """Return figures for people; `clock` is what `frame` counts. No frame is the worst where all have none."""
        worst = {"most in one frame": f"{self.worst:.2%}, {self.clip} at {clock} {self.frame:g}"}
        return {
            SHARE: f"{self.mean:.3%}, the mean of {self.frames} frames",
            **(worst if self.worst else {}),
            **({"mostly at": self.where} if self.where else {}),
        }

    def to_metadata(self) -> dict[str, object]:
        """Return figures of four digits, as a shot stores them."""
        regions = {joint: round(share, 4) for joint, share in self.regions.items()}
        return {**super().to_metadata(), "regions": regions}

    def __str__(self) -> str:
        worst = f"{self.clip}, frame {self.frame:g}" + (f"; most at {self.where}" if self.where else "")
        most = f", {self.worst:.2%} in the worst of {self.frames} frames ({worst})" if self.worst else ""
        return f"{self.mean:.3%} of the triangles intersect others{most}"


@dataclass(frozen=True, kw_only=True)
class LayerFigures(TriangleShares):
    """How a garment lies over another one, over frames: its triangles intersect those of the inner garment.

    Attributes:
        outer, inner: the garments.
        shown, worst_shown: share of the inner cloth, as far as the outer covers it in the bind pose, that shows
            through; None where it covers none.
    """

    outer: str
    inner: str
    shown: float | None = None
    worst_shown: float | None = None

    def summary(self, clock: str = "frame") -> dict[str, str]:
        """Return figures for people; `clock` is what `frame` counts."""
        worst = f", {self.worst:.2%} in {self.clip} at {clock} {self.frame:g}" if self.worst else ""
        told = {f"triangles that intersect {self.inner}": f"{self.mean:.3%}{worst}"}
        if self.shown is not None:
            told[f"{self.inner} that shows through"] = f"{self.shown:.3%}, {self.worst_shown:.2%} at most"
        return told

    def __str__(self) -> str:
        worst = f", {self.worst:.2%} in the worst of {self.frames} frames ({self.clip}, frame {self.frame:g})"
        text = f"{self.mean:.3%} of the triangles intersect {self.inner}{worst if self.worst else ''}"
        if self.shown is None:
            return text
        return f"{text}; {self.shown:.3%} of {self.inner} shows through, {self.worst_shown:.2%} at most"
