# SPDX-License-Identifier: Apache-2.0
"""What a bake and its verification found, with units in the names, and as figures for people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ...physics.intersections.figures import NOT_COUNTED, SHARE, SelfIntersections
from ...physics.skin.figures import ShownSkin
from ...physics.world.sunk import SunkCloth
from ...quality.levels import SizeReduction
from .entered import EnteredCloth

if TYPE_CHECKING:
    from ...scene.decomposition import Decomposition

SHOT_SHAPES = "shapes of the shot"
SKINNED = "skinned"  # what a shot says of the points of another simulator that it stands for


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
    Joints and blendshapes that stand for refined, simulated or cached points are compared with these. Shots that were
    refined with feedback are later checked for being complete alone.

    Attributes:
        frames: samples of the shot.
        largest_error_m: distance of the vertex that is nearest to its bound [m]; None where energies were compared,
            or nothing.
        allowed_error_m: the bound there [m].
        mean_energy_j: mean energy of the refined frames [J]; None where vertices were compared.
        rms_error_m: RMS distance from the points that the shot stands for [m]; None where it holds its own vertices.
        stated_faults: what the certificate of the file says of how free its frames are, where that was checked.
        counted_faults: what was found of it.
        seam_mm: distance between the first frame of a loop and where its last ones lead, of the vertex that misses it
            most [mm]; None where it is no loop.
    """

    frames: int
    largest_error_m: float | None = None
    allowed_error_m: float | None = None
    mean_energy_j: float | None = None
    rms_error_m: float | None = None
    stated_faults: str | None = None
    counted_faults: str | None = None
    seam_mm: float | None = None

    def figures(self) -> dict[str, object]:
        """Return figures for people."""
        stated = {"certificate of the file": self.stated_faults, "counted in it": self.counted_faults}
        seam = {} if self.seam_mm is None else {"seam of the loop, at most [mm]": f"{self.seam_mm:.3g}"}
        compared = {**self._compared(), **seam}
        return {**compared, **{name: value for name, value in stated.items() if value is not None}}

    def _compared(self) -> dict[str, object]:
        if self.mean_energy_j is not None:
            return {
                "frames of lower energy than the network's": self.frames,
                "mean energy [J]": f"{self.mean_energy_j:.4g}",
            }
        if self.largest_error_m is None or self.allowed_error_m is None:
            return {"frames that are complete": self.frames}
        rms = {} if self.rms_error_m is None else {"RMS error [mm]": f"{1000 * self.rms_error_m:.3g}"}
        return {
            **rms,
            "largest error [mm]": f"{1000 * self.largest_error_m:.3g}",
            "allowed [mm]": f"{1000 * self.allowed_error_m:.3g}",
        }


@dataclass(frozen=True, kw_only=True)
class ShotShapes:
    """How vertices became joints and blendshapes.

    Attributes:
        count, local: the shot's own blendshapes, and those of them that move few vertices.
        rms_mm, largest_mm: distance from the vertices over all of them and all frames [mm].
        point_bytes: what the vertices take as float32 points.
    """

    count: int
    local: int
    rms_mm: float
    largest_mm: float
    point_bytes: int

    @classmethod
    def of(cls, shot: Decomposition) -> ShotShapes:
        """Return the figures of a decomposition."""
        vertices = shot.deformer.scene.garment.mesh.vertex_count
        frames = sum(pose.frame_count for pose in shot.poses)
        return cls(
            count=shot.own_shapes,
            local=shot.local_shapes,
            rms_mm=1000 * shot.rms,
            largest_mm=1000 * shot.largest,
            point_bytes=12 * vertices * frames,  # three float32 each
        )

    def to_metadata(self) -> dict[str, float]:
        """Return figures of four digits, as a shot stores them."""
        return {
            SHOT_SHAPES: self.count,
            "of few vertices": self.local,
            "joints lose, RMS [mm]": float(f"{self.rms_mm:.4g}"),
            "joints lose, at most [mm]": float(f"{self.largest_mm:.4g}"),
            "bytes of the points alone": self.point_bytes,
        }


@dataclass(frozen=True, kw_only=True)
class RefinementSummary:
    """What the solver changed, as means over the frames.

    Attributes:
        iterations: of the solver in each frame, at most.
        energy_before_j, energy_j: means of `refine.FrameChange.before` and `after` [J].
        inside_before, inside: share of the vertices inside the body.
        moved_m: RMS distance over the mass [m].
        shapes: how the refined vertices became joints and blendshapes; None where points are written.
    """

    iterations: int
    energy_before_j: float
    energy_j: float
    inside_before: float
    inside: float
    moved_m: float
    shapes: ShotShapes | None = None

    def to_metadata(self) -> dict[str, float]:
        """Return figures of four digits, as a shot stores them."""
        stated = {
            "energy before [J]": self.energy_before_j,
            "energy [J]": self.energy_j,
            "inside the body before": self.inside_before,
            "inside the body": self.inside,
            "moved [m]": self.moved_m,
        }
        rounded = {name: float(f"{value:.4g}") for name, value in stated.items()}
        return {"iterations": self.iterations, **rounded, **(self.shapes.to_metadata() if self.shapes else {})}

    def figures(self) -> dict[str, object]:
        """Return figures for people, in the units of the others: joules, shares in percent, lengths in mm."""
        return {
            "iterations": self.iterations,
            "energy before [J]": float(f"{self.energy_before_j:.4g}"),
            "energy [J]": float(f"{self.energy_j:.4g}"),
            "inside the body before": f"{self.inside_before:.3%}",
            "inside the body": f"{self.inside:.3%}",
            "moved, RMS [mm]": float(f"{1000 * self.moved_m:.4g}"),
            **(self.shapes.to_metadata() if self.shapes else {}),
        }


@dataclass(frozen=True, kw_only=True)
class LatentSummary:
    """How well states were solved for in latents, at the model's rate, run-up included.

    Attributes:
        iterations: of the solver in each frame, at most; the first of a shot has more.
        elements: over which the energies are summed, "all" or "few".
        frames: that were solved.
        energy_before_j, energy_j: mean energies of the best of the starts and of the solution [J].
        left: mean share of the energy that the solver's model still promised, of that and what was gained.
        step_left_mm, largest_step_left_mm: how far the cloth of a frame may still move, at most (RMS over the mass),
            the median over frames and the largest [mm].
        unconverged: frames with more left than the tolerance.
        failed: frames among them whose last line search found nothing lower.
    """

    iterations: int
    elements: str
    frames: int
    energy_before_j: float
    energy_j: float
    left: float
    step_left_mm: float
    largest_step_left_mm: float
    unconverged: int
    failed: int

    def to_metadata(self) -> dict[str, float | str]:
        """Return figures of four digits, as a shot stores them."""
        counts = {"frames not converged": self.unconverged, "line searches that failed": self.failed}
        return {**self.figures(), **counts}

    def figures(self) -> dict[str, float | str]:
        """Return figures for people: how far frames have come, not the counts of the solver."""
        return {
            "iterations": self.iterations,
            "elements": self.elements,
            "frames": self.frames,
            "energy before [J]": float(f"{self.energy_before_j:.4g}"),
            "energy [J]": float(f"{self.energy_j:.4g}"),
            "left of the gain": float(f"{self.left:.4g}"),
            "left to move, median [mm]": float(f"{self.step_left_mm:.4g}"),
            "left to move, at most [mm]": float(f"{self.largest_step_left_mm:.4g}"),
        }


@dataclass(frozen=True, kw_only=True)
class LoopSummary:
    """How the end of a loop meets its beginning, in the vertices of the garment.

    Attributes:
        samples: of the shot in a round.
        closed: whether the last frame shows the pose of the first, else the one before that.
        rounds: that were played until the written one ended.
        repeats: whether the garment's state had come to repeat by then.
        blended_mm: distance between the beginnings of this round and the next, of the vertex that is farthest off in
            two frames [mm]: what the last frames are blended over.
        seam_at_rest_mm, seam_mm: distance between the first frame and where the last ones lead, of the vertex that
            misses it most [mm]: of a round that starts at rest, and of the one that is written.
        body_mm: likewise, of the character's joints.
        jump_at_rest, jump: RMS change of the velocity at the seam [m/s], likewise.
        usual_jump, largest_jump: the same from sample to sample within the round, in the mean and at most.
        travel_m: how far a round takes the garment [m].
        turn_degrees: by how much it turns it about the vertical.
    """

    samples: int
    closed: bool
    rounds: int
    repeats: bool
    blended_mm: float
    seam_at_rest_mm: float
    seam_mm: float
    body_mm: float
    jump_at_rest: float
    jump: float
    usual_jump: float
    largest_jump: float
    travel_m: float
    turn_degrees: float

    def to_metadata(self) -> dict[str, float | str]:
        """Return figures of three digits and three decimals, as a shot stores them and for people."""
        last = "shows the first one's pose" if self.closed else "is one before the first"
        figures = {
            "seam from rest, at most [mm]": self.seam_at_rest_mm,
            "seam before blending, at most [mm]": self.blended_mm,
            "seam, at most [mm]": self.seam_mm,
            "joints miss, at most [mm]": self.body_mm,
            "velocity jumps from rest [m/s]": self.jump_at_rest,
            "velocity jumps [m/s]": self.jump,
            "within the round, mean [m/s]": self.usual_jump,
            "within the round, at most [m/s]": self.largest_jump,
            "travels [m]": self.travel_m,
            "turns [degrees]": self.turn_degrees,
        }
        # Files hold single precision: what is smaller than a thousandth is noise.
        rounded = {name: float(f"{round(value, 3) + 0.0:.3g}") for name, value in figures.items()}
        state = "repeats" if self.repeats else "does not repeat"
        return {"samples": self.samples, "last frame": last, "rounds": self.rounds, "state": state, **rounded}


def certified_frames(frames: int, intersecting: int, showing: int, over: Sequence[str] = ()) -> str:
    """Return in words in how many frames triangles intersect others, and covered skin shows.

    Args:
        over: garments beneath, whose triangles count as well.
    """
    others = f" themselves or {', '.join(over)}" if over else ""
    return f"{intersecting:,} of {frames:,} frames intersect{others}, {showing:,} show covered skin"


@dataclass(frozen=True, kw_only=True)
class CertificateSummary:
    """What was found in each frame of a written file whose frames were moved until nothing is wrong in them.

    Attributes:
        frames: of the shot, or its samples.
        faulty: those of them in which triangles intersected others, or covered skin showed.
        moved: frames that were moved; those around faulty ones are taken along.
        intersecting, showing: frames in which triangles still intersect others, and covered skin still shows.
        left: frames of either kind, from the first of the shot on, which is 0.
        codes: first and last time code of each of these spans.
        reasons: what is wrong in each of them, and where.
        mean_mm, largest_mm: displacement of the vertices that were moved, in these frames [mm].
        over: garments beneath, with which triangles must not intersect either.
    """

    frames: int
    faulty: int
    moved: tuple[FrameSpan, ...]
    intersecting: int
    showing: int
    left: tuple[FrameSpan, ...]
    codes: tuple[tuple[float, float], ...]
    reasons: tuple[str, ...]
    mean_mm: float
    largest_mm: float
    over: tuple[str, ...] = ()

    @property
    def unfree(self) -> str:
        """The frames that have no free position in words; empty where there are none."""
        if not self.left:
            return ""
        count = sum(span.last - span.first + 1 for span in self.left)
        spans = [f"{first:g} to {last:g}, {why}" for (first, last), why in zip(self.codes, self.reasons)]
        return f"{count} frames have no free position: {'; '.join(spans)}"

    def __str__(self) -> str:
        said = certified_frames(self.frames, self.intersecting, self.showing, self.over)
        return f"{said}; {self.unfree}" if self.left else said

    def figures(self) -> dict[str, object]:
        """Return figures for people."""
        moved = sum(span.last - span.first + 1 for span in self.moved)
        return {
            "certificate": str(self),
            "frames that were wrong": self.faulty,
            "frames that were moved": moved,
            "moved by, mean and most [mm]": f"{self.mean_mm:.2g}, {self.largest_mm:.3g}",
        }

    def to_metadata(self) -> dict[str, object]:
        """Return what a shot says of itself."""
        return {
            "found": str(self),
            "frames wrong before": self.faulty,
            "moved frames": [str(span) for span in self.moved],
            "frames left": [str(span) for span in self.left],
            "mean [mm]": float(f"{self.mean_mm:.4g}"),
            "largest [mm]": float(f"{self.largest_mm:.4g}"),
        }


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
        latent: how well states were solved for in latents, where that was asked for.
        loop: how its end meets its beginning; None where it is no loop.
        shapes: how the vertices of another simulator became joints and blendshapes; None where nothing was fitted.
        hidden_faces: faces of the bodies that are hidden; None where that was not asked for.
        recovered: frames at which the rollout was lost and the garment was put to rest.
        shown_skin: the share of the covered skin that shows; None where the garment covers nothing.
        intersections: the share of triangles that intersect others of the garment; None where it was not counted.
        sunk: the share of vertices inside colliders; None where there are no colliders.
        entered: riders that enter their cloth.
        certificate: how free of intersections and of skin that shows each frame is; None where that was not asked.
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
    latent: LatentSummary | None = None
    loop: LoopSummary | None = None
    shapes: ShotShapes | None = None
    hidden_faces: int | None = None
    recovered: tuple[FrameSpan, ...] = ()
    shown_skin: ShownSkin | None = None
    intersections: SelfIntersections | None = None
    sunk: SunkCloth | None = None
    entered: tuple[EnteredCloth, ...] = ()
    certificate: CertificateSummary | None = None
    current: bool = False

    def figures(self, kind: str = "shot") -> dict[str, object]:
        """Return figures for people; `kind` is what the file is called."""
        if self.current:
            return {kind: str(self.path), "current": True}
        refined = self.refinement.figures() if self.refinement else {}
        latent = self.latent.figures() if self.latent else {}
        loop = self.loop.to_metadata() if self.loop else {}
        return {
            kind: str(self.path),
            "frames": self.frames,
            "fps": self.fps,
            "joints": self.joints,
            "proxies": self.proxies,
            "blendshapes": self.blendshapes,
            "bytes": self.size_bytes,
            **(self.reduction.to_metadata() if self.reduction else {}),
            **{f"latents: {name}": value for name, value in latent.items()},
            **{f"loop: {name}": value for name, value in loop.items()},
            **{f"refined: {name}": value for name, value in refined.items()},
            **(self.shapes.to_metadata() if self.shapes else {}),
            **(self.shown_skin.summary("time code") if self.shown_skin else {}),
            **(self.intersections.summary("time code") if self.intersections else {SHARE: NOT_COUNTED}),
            **(self.sunk.summary("time code") if self.sunk else {}),
            **{name: value for each in self.entered for name, value in each.summary("time code").items()},
            **(self.certificate.figures() if self.certificate else {}),
            **(self.verification.figures() if self.verification else {}),
            **({} if self.hidden_faces is None else {"hidden faces of the body": self.hidden_faces}),
            **({"put to rest": [str(span) for span in self.recovered]} if self.recovered else {}),
        }
