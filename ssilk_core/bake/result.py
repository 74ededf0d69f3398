# SPDX-License-Identifier: Apache-2.0
"""What a bake and its verification found, with units in the names, and as figures for people."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from ..quality import SizeReduction
from ..shown_skin import ShownSkin


@dataclass(frozen=True)
class FrameSpan:
    """Consecutive frames, both ends included."""

    first: int
    last: int

    def __str__(self) -> str:
        return f"{self.first} to {self.last}"


@dataclass(frozen=True, kw_only=True)
class Verification:
    """How a written shot compares with what was computed.

    Points that an earlier bake refined are judged by energy instead: no frame has more than the network's state.

    Attributes:
        frames: samples of the shot that were compared.
        largest_error_m: distance of the vertex that is nearest to its bound [m]; None where energies were compared.
        allowed_error_m: the bound there [m].
        mean_energy_j: mean energy of the refined frames [J]; None where vertices were compared.
    """

    frames: int
    largest_error_m: float | None = None
    allowed_error_m: float | None = None
    mean_energy_j: float | None = None

    def figures(self) -> dict[str, object]:
        """Return figures for people."""
        if self.mean_energy_j is not None:
            return {
                "frames of lower energy than the network's": self.frames,
                "mean energy [J]": f"{self.mean_energy_j:.4g}",
            }
        return {
            "largest error [m]": f"{self.largest_error_m:.3g}",
            "allowed [m]": f"{self.allowed_error_m:.3g}",
        }


@dataclass(frozen=True, kw_only=True)
class RefinementSummary:
    """What the solver changed, as means over the frames.

    Attributes:
        iterations: of the solver in each frame, at most.
        energy_before_j, energy_j: of the network's state, and of the refined one with the same past [J].
        inside_before, inside: share of the vertices inside the body.
        moved_m: RMS distance over the mass [m].
        fit_rms_mm, fit_max_mm: distance of fitted joints and blendshapes from the refined vertices [mm]; None where
            points are written.
    """

    iterations: int
    energy_before_j: float
    energy_j: float
    inside_before: float
    inside: float
    moved_m: float
    fit_rms_mm: float | None = None
    fit_max_mm: float | None = None

    def to_metadata(self) -> dict[str, float]:
        """Return figures of four digits, as a shot stores them."""
        stated = {
            "energy before [J]": self.energy_before_j,
            "energy [J]": self.energy_j,
            "inside the body before": self.inside_before,
            "inside the body": self.inside,
            "moved [m]": self.moved_m,
            "joints lose, RMS [mm]": self.fit_rms_mm,
            "joints lose, at most [mm]": self.fit_max_mm,
        }
        rounded = {name: float(f"{value:.4g}") for name, value in stated.items() if value is not None}
        return {"iterations": self.iterations, **rounded}


@dataclass(frozen=True, kw_only=True)
class BakeResult:
    """A written shot, or a layer of one.

    Attributes:
        path: of the file.
        frames: samples that were written, `samples_per_frame` of them in each frame.
        fps: frames per second [1/s].
        joints, proxies: joints of the shot; those of them that the garment adds.
        blendshapes: of the garment.
        size_bytes: of the file.
        verification: None where none was asked for.
        reduction: what was kept of the model, where less than all.
        refinement: what the solver changed, where it was asked to.
        hidden_faces: faces of the bodies that are hidden; None where that was not asked for.
        recovered: frames at which the rollout was lost and the garment was put to rest.
        shown_skin: the share of the covered skin that shows; None where the garment covers nothing.
        current: the file was there already and nothing was baked; the other figures are those of its bake.
    """

    path: Path
    frames: int
    fps: float
    joints: int
    proxies: int
    blendshapes: int
    size_bytes: int
    verification: Verification | None = None
    reduction: SizeReduction | None = None
    refinement: RefinementSummary | None = None
    hidden_faces: int | None = None
    recovered: tuple[FrameSpan, ...] = ()
    shown_skin: ShownSkin | None = None
    current: bool = False

    def figures(self, kind: str = "shot") -> dict[str, object]:
        """Return figures for people; `kind` is what the file is called."""
        if self.current:
            return {kind: str(self.path), "current": True}
        refined = self.refinement.to_metadata() if self.refinement else {}
        return {
            kind: str(self.path),
            "frames": self.frames,
            "fps": self.fps,
            "joints": self.joints,
            "proxies": self.proxies,
            "blendshapes": self.blendshapes,
            "bytes": self.size_bytes,
            **(self.reduction.to_metadata() if self.reduction else {}),
            **{f"refined: {name}": value for name, value in refined.items()},
            **(self.shown_skin.summary() if self.shown_skin else {}),
            **(self.verification.figures() if self.verification else {}),
            **({} if self.hidden_faces is None else {"hidden faces of the body": self.hidden_faces}),
            **({"put to rest": [str(span) for span in self.recovered]} if self.recovered else {}),
        }
