# SPDX-License-Identifier: Apache-2.0
"""The share of covered skin that shows, as figures; `collision.covered_skin` measures it."""

from __future__ import annotations

from dataclasses import dataclass

COVER_REACH, SHOW_DEPTH = 0.08, 0.03  # [m]: how far cloth above covers a point, and how far beneath it is seen


@dataclass(frozen=True, kw_only=True)
class ShownSkin:
    """The share of covered skin that shows, over frames.

    Attributes:
        frames: that were counted.
        covered: points that the garment covers.
        mean, worst: mean share over frames, and that of the worst frame.
        clip, frame: the worst frame; of several equal ones the first.
        regions: share of what shows, of all frames together, at the joints that move most of it, largest first.
    """

    frames: int
    covered: int
    mean: float
    worst: float
    clip: str
    frame: int
    regions: dict[str, float]

    @property
    def where(self) -> str:
        """The regions in words; empty where nothing shows, or where joints are not known."""
        return ", ".join(f"{joint} {share:.0%}" for joint, share in self.regions.items())

    def summary(self) -> dict[str, str]:
        """Return figures for people."""
        return {
            "covered skin that shows": f"{self.mean:.3%}",
            "in the worst frame": f"{self.worst:.2%}, {self.clip} at {self.frame}",
            **({"most at": self.where} if self.where else {}),
        }

    def to_metadata(self) -> dict[str, object]:
        """Return figures of four digits, as a shot stores them."""
        rounded = {name: float(f"{getattr(self, name):.4g}") for name in ("mean", "worst")}
        return {**vars(self), **rounded, "regions": {joint: round(share, 4) for joint, share in self.regions.items()}}

    def __str__(self) -> str:
        worst = f"{self.clip}, frame {self.frame}" + (f"; most at {self.where}" if self.where else "")
        return f"{self.mean:.3%} of the covered skin shows, {self.worst:.2%} in the worst frame ({worst})"
