# SPDX-License-Identifier: Apache-2.0
"""The share of covered skin that shows, as figures; `collision.covered_skin` measures it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class ShownSkin:
    """The share of covered skin that shows, over frames.

    Attributes:
        covered: points that the garment covers.
        mean, worst: mean share over frames, and that of the worst frame.
        clip, frame: the worst frame; of several equal ones the first.
        regions: share of what shows, of all frames together, at the joints that move most of it, largest first.
    """

    covered: int
    mean: float
    worst: float
    clip: str
    frame: int
    regions: dict[str, float]

    def __str__(self) -> str:
        """Say where in brackets: "0.78% of the covered skin shows, 2.0% in the worst frame (walk, frame 31: ...)"."""
        where = ", ".join(f"{joint} {share:.0%}" for joint, share in self.regions.items())
        worst = f"{self.clip}, frame {self.frame}" + (f"; most at {where}" if where else "")
        return f"{self.mean:.3%} of the covered skin shows, {self.worst:.2%} in the worst frame ({worst})"
