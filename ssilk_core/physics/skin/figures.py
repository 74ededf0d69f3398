# SPDX-License-Identifier: Apache-2.0
"""The shares of covered skin that show and that are bare, as figures; `skin.covered_skin` measures it."""

from __future__ import annotations

from dataclasses import dataclass, field

COVER_REACH, SHOW_DEPTH = 0.08, 0.03  # [m]: how far cloth above covers a point, and how far beneath it is seen
MOST_MEAN, MOST_WORST = 5e-4, 5e-3  # shares that show on average and in one frame; the eye finds more at once


@dataclass(frozen=True, kw_only=True)
class ShownSkin:
    """The share of covered skin that shows, over frames, and beside it the share that is bare.

    Attributes:
        frames: that were counted.
        covered: points that the garment covers.
        mean, worst: mean share over frames, and that of the worst frame.
        bare, worst_bare: the same of skin with no cloth within reach.
        clip, frame: the worst frame, of several equal ones the first: of a shot its time code, of a motion that was
            evaluated the motion's, and of a validation in training the frame from the clip's start, at the model's
            rate.
        regions: share of what shows, of all frames together, at the joints that move most of it, largest first.
        pierced: share of the frames in which a limb pierces loose cloth; None where it was not counted.
        limbs: share of the frames in which each limb does, by the joint at its tip, largest first.
    """

    frames: int
    covered: int
    mean: float
    worst: float
    clip: str
    frame: float
    regions: dict[str, float]
    bare: float
    worst_bare: float
    pierced: float | None = None
    limbs: dict[str, float] = field(default_factory=dict)

    @property
    def where(self) -> str:
        """The regions in words; empty where nothing shows, or where joints are not known."""
        return ", ".join(f"{joint} {share:.0%}" for joint, share in self.regions.items())

    @property
    def _limbs(self) -> str:
        most = ", ".join(f"{joint} {share:.1%}" for joint, share in self.limbs.items())
        return f"{self.pierced:.1%}" + (f" ({most})" if most else "")

    @property
    def is_seen(self) -> bool:
        """Whether the eye finds at once what shows."""
        return self.mean > MOST_MEAN or self.worst > MOST_WORST

    def summary(self, clock: str = "frame") -> dict[str, str]:
        """Return figures for people; `clock` is what `frame` counts. No frame is the worst where nothing shows."""
        worst = {"in the worst frame": f"{self.worst:.2%}, {self.clip} at {clock} {self.frame:g}"}
        return {
            "covered skin that shows": f"{self.mean:.3%}",
            **(worst if self.worst else {}),
            **({"most at": self.where} if self.where else {}),
            "bare": f"{self.bare:.2%}",
            "bare in its worst frame": f"{self.worst_bare:.2%}",
            **({} if self.pierced is None else {"frames with limbs through the cloth": self._limbs}),
        }

    def to_metadata(self) -> dict[str, object]:
        """Return figures of four digits, as a shot stores them."""
        known = {name: value for name, value in vars(self).items() if value is not None}
        rounded = {name: float(f"{value:.4g}") for name, value in known.items() if isinstance(value, float)}
        shares = {
            name: {joint: round(share, 4) for joint, share in found.items()}
            for name, found in (("regions", self.regions), ("limbs", self.limbs))
        }
        return {**known, **rounded, **shares}

    def __str__(self) -> str:
        worst = f"{self.clip}, frame {self.frame:g}" + (f"; most at {self.where}" if self.where else "")
        bare = f", {self.bare:.2%} is bare ({self.worst_bare:.2%} at most)"
        most = f", {self.worst:.2%} in the worst frame ({worst})" if self.worst else ""
        through = f"; a limb is through the cloth in {self._limbs} of the frames" if self.pierced else ""
        return f"{self.mean:.3%} of the covered skin shows{most}{bare}{through}"
