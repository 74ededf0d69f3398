# SPDX-License-Identifier: Apache-2.0
"""Written shots compared with what was computed."""

from __future__ import annotations

import os
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ...errors import VerificationError, fail
from ...events import Message, Reporter, Result, Started, silent
from ...files import sha256
from ...scene.assets import Floats
from ...scene.cycles import LEAST_FRAMES
from ..gltf.play import GlbShot
from ..targets import GLB
from .beneath import GarmentsBeneath, beneath_said
from .certificate.verified import verify_certificate
from .load import load_rollout
from .looped import seam
from .opened import open_shot, provenance_of
from .origin import REFINED, read_origin
from .refinement import refined_points, verify_energies
from .result import SKINNED, Verification
from .riders import verify_riders
from .rollout import BakeRollout

if TYPE_CHECKING:
    from ssilk_usd.checking.shot import PosedGarment
    from ssilk_usd.shots.play import Shot

    from ...scene.decomposition import FitTolerance


def verify(
    shot: str | os.PathLike[str],
    *,
    model: str | os.PathLike[str] | None = None,
    stage: str | os.PathLike[str] | None = None,
    motion: str | os.PathLike[str] | None = None,
    cache: str | os.PathLike[str] | None = None,
    device: str | None = None,
    report: Reporter = silent,
) -> Verification:
    """Check a baked shot and compare it, re-skinned by UsdSkel alone, with the decoder's own vertices.

    A shot that was made from a point cache is compared with that.

    Args:
        shot: file written by `bake` or `skin`, or animation layer written by `bake_layers`.
        model, stage, motion, cache: new path of an input that has moved, and not together with the shot.
        device: where the network runs; None for where it ran for the bake.
        report: takes events.

    Raises:
        SsilkError: the shot was not baked here, or an input is missing or does not fit.
        VerificationError: a check fails, or a vertex is further off than allowed.
    """
    path = Path(shot)
    said = _said_of_points(path)
    if said is not None:
        report(Started("verify", 1, {"shot": str(path)}))
        found = _verify_skinned(path, said, cache, report)
        report(Result("verify", {"shot": str(path), **found.figures()}))
        return found
    origin = read_origin(path, {"model": model, "stage": stage, "motion": motion})
    rollout = load_rollout(replace(origin.request, device=device or origin.request.device))
    for name, then in origin.hashes.items():
        if then != rollout.provenance[f"{name}_sha256"]:
            what = name.replace("_", " ")
            text = f"{getattr(origin.request, name)}: the {what} has changed since the shot was baked from it"
            report(Message(text, "warning"))
    report(Started("verify", rollout.motion.frame_count, {"shot": str(path)}))
    found = verify_file(rollout, path, report)
    cloth = {"fabric": rollout.fabric_words} if rollout.played else {}
    report(Result("verify", {"shot": str(path), **cloth, **found.figures()}))
    return found


def _verify_skinned(
    shot: Path, said: Mapping[str, object], cache: str | os.PathLike[str] | None, report: Reporter
) -> Verification:
    """Compare a shot with the cache that it was made from.

    Args:
        said: what the shot says under `SKINNED`.
        cache: present path of the cache, where it has moved.

    Raises:
        SsilkError: the cache is not found.
        VerificationError: a check fails, or the shot is further off than it was made to be.
    """
    from ssilk_usd.shots.trajectories import MeshTrajectories

    from ...scene.decomposition import FitTolerance

    if "cache" not in said:
        found, allowed = "its points were simulated and not kept", "only a shot of a cache can be compared with it"
        fail(str(shot), found, allowed, "'ssilk simulate --points' keeps them, 'ssilk skin' makes a shot of those")
    near = shot.parent / str(said["cache"])
    path = Path(cache) if cache else near
    if not path.is_file():
        fail(str(shot), f"the cache that it was made from is not at {path}", "--cache gives its present path")
    if sha256(path) != said.get("cache_sha256"):
        report(Message(f"{path}: the cache has changed since the shot was made from it", "warning"))
    need_valid(shot, report)
    tolerance = FitTolerance(rms=float(str(said["rms"])), largest=float(str(said["largest"])))
    return compare_trajectories(open_shot(shot), MeshTrajectories(f"{path}:{said['mesh']}"), tolerance=tolerance)


def verify_file(rollout: BakeRollout, path: Path, report: Reporter) -> Verification:
    """Check a file and compare it, re-skinned by its format's rules alone, with the rollout that it should hold.

    Points of an earlier refinement are compared by energy (`verify_energies`), unless the rollout has its own. Joints
    of one are compared with the refined points, with the tolerance that they were fitted with. Of one with feedback,
    and of an earlier solve in latents, only the number of frames and vertices is checked, and that these are finite.

    Raises:
        VerificationError: a check fails, or a vertex is further off than allowed.
    """
    need_valid(path, report)
    shot = open_shot(path)
    return replace(_verify_shot(rollout, path, shot, report), seam_mm=_seam(rollout, shot))


def _seam(rollout: BakeRollout, shot: PosedGarment) -> float | None:
    """Return how far the end of a loop misses its beginning in its file [mm]; None where it is no loop."""
    times = shot.sample_times(rollout.request.samples_per_frame)
    if rollout.loop is None or len(times) < LEAST_FRAMES:
        return None
    points = [shot.garment_points(time) for time in (*times[:3], *times[-2:])]
    return 1000 * seam(rollout.loop.cycle, points[:3], points[3:], rollout.motion.fps).apart


def _verify_shot(rollout: BakeRollout, path: Path, shot: Shot | GlbShot, report: Reporter) -> Verification:
    verify_riders(shot, shot.sample_times(rollout.request.samples_per_frame), rollout.rider_joints(), report)
    if not (rollout.request.certify and rollout.certificate is None):
        return _verify_points(rollout, path, shot, None, report)
    checked = verify_certificate(rollout, path, report)
    found = _verify_points(rollout, path, shot, checked.moved, report)
    return replace(found, stated_faults=checked.said, counted_faults=checked.counted)


def _verify_points(
    rollout: BakeRollout, path: Path, shot: Shot | GlbShot, moved: Container[int] | None, report: Reporter
) -> Verification:
    """Compare the points of a file with the rollout that it should hold, but for frames that a certificate moved."""
    from ssilk_usd.checking.shot import compare_points

    samples = rollout.request.samples_per_frame
    times = shot.sample_times(samples)
    solve_again = rollout.request.refine and rollout.refinement is None
    below = _refined_over(path, samples, report) if solve_again else None
    if rollout.request.latent_iterations and rollout.latents is None:
        return _verify_extent(shot, times, path, rollout, report, "solved in latents")
    if solve_again:
        if rollout.request.feedback:
            return _verify_extent(shot, times, path, rollout, report, "refined with feedback")
        if rollout.direction is not None and not shot.is_skinned:  # held points have any energy
            return _verify_extent(shot, times, path, rollout, report, "refined, and held for a while")
        if not shot.is_skinned:
            return verify_energies(rollout, map(shot.garment_points, times), below, report)
        if not rollout.request.writes_points:
            again = refined_points(rollout, report, below)
            fitted = _with_moved(shot, times, again, moved)
            return compare_trajectories(shot, fitted, samples_per_frame=samples)
    expected = rollout.vertices(report) if shot.is_skinned else rollout.points(report)
    expected = _with_moved(shot, times, expected, moved)
    found = compare_points(shot, expected, samples_per_frame=samples)
    if not found.passed:
        todo = "bake it again, closer to the origin if it is many kilometres away"
        if isinstance(shot, GlbShot) and shot.rewritten:
            todo = f"{shot.rewritten}: verify it before that"
        raise VerificationError(
            f"{path}: vertex {found.vertex} at time code {found.time:g} is {found.worst:.3g} m from where the "
            f"decoder has it; at most {found.bound:.3g} m is allowed, wherever it is; {todo}."
        )
    return Verification(frames=len(times), largest_error_m=found.worst, allowed_error_m=found.bound)


def _refined_over(path: Path, samples: int, report: Reporter) -> GarmentsBeneath | None:
    """Return the garments that a file says it was refined over; raise `VerificationError` where one is not there."""
    said = provenance_of(path).get(REFINED)
    return beneath_said(said, path, samples, "refined", report) if isinstance(said, Mapping) else None


def _with_moved(
    shot: PosedGarment, times: Sequence[float], expected: Iterator[Floats], moved: Container[int] | None
) -> Iterator[Floats]:
    """Yield what a shot should hold (V, 3) [m], with its own points in frames that a certificate says were moved.

    The last digits of where they were moved to depend on the machine.
    """
    for frame, points in enumerate(expected):
        is_moved = moved is not None and frame < len(times) and frame in moved
        yield shot.garment_points(times[frame]) if is_moved else points


def _verify_extent(
    shot: PosedGarment, times: Sequence[float], path: Path, rollout: BakeRollout, report: Reporter, made: str
) -> Verification:
    """Check that a shot has all frames and vertices of a rollout that a solver `made`.

    Where a solver goes on from its own states, a frame depends on all before it, and on another machine other last
    digits grow with each.
    """
    if len(times) != rollout.motion.frame_count:
        raise VerificationError(f"{path}: it has {len(times)} samples; {rollout.motion.frame_count} are needed.")
    count = rollout.deformer.scene.garment.mesh.vertex_count
    for time in times:
        points = shot.garment_points(time)
        if points.shape != (count, 3) or not np.isfinite(points).all():
            raise VerificationError(
                f"{path}: its garment at time code {time:g} is not {count} finite points; bake it again."
            )
    report(Message(f"{path}: {made}; its vertices are not compared with the solver's again"))
    return Verification(frames=len(times))


def _said_of_points(shot: Path) -> Mapping[str, object] | None:
    """Return what a shot says of the points that it was made from; None where it was baked from a model."""
    said = provenance_of(shot).get(SKINNED) if shot.is_file() else None
    return said if isinstance(said, Mapping) else None


def compare_trajectories(
    shot: PosedGarment, points: Iterable[Floats], *, tolerance: FitTolerance | None = None, samples_per_frame: int = 1
) -> Verification:
    """Compare the garment of a shot, re-skinned from its file alone, with the points that it stands for.

    Args:
        points: of each of its samples in the world [m], shape (V, 3).
        tolerance: that it was fitted with; `FitTolerance()` by default.

    Raises:
        VerificationError: other frames or vertices, or they are further off than allowed.
    """
    from ssilk_usd.checking.shot import allowed_error

    from ...scene.decomposition import FitTolerance

    tolerance, times = tolerance or FitTolerance(), shot.sample_times(samples_per_frame)
    squares, count, slack, worst = 0.0, 0, 0.0, (0.0, tolerance.largest, 0.0, 0)
    for time, wanted in zip_longest(times, points):
        if time is None or wanted is None:
            raise VerificationError(f"{shot.name}: the shot has another number of frames than what it stands for.")
        found = shot.garment_points(time)
        if found.shape != wanted.shape:
            raise VerificationError(
                f"{shot.name}: the garment has {len(found)} vertices, but what it stands for has {len(wanted)}."
            )
        away = np.nan_to_num(np.linalg.norm(found - wanted, axis=-1), nan=np.inf)
        slack = max(slack, allowed_error(wanted))
        squares, count, vertex = squares + float((away**2).sum()), count + len(away), int(away.argmax())
        bound = tolerance.largest + allowed_error(wanted)
        worst = max(worst, (float(away[vertex]), bound, time, vertex), key=lambda each: each[0] / each[1])
    rms = float(np.sqrt(squares / max(count, 1)))
    if not (rms <= tolerance.rms + slack and worst[0] <= worst[1]):
        raise VerificationError(
            f"{shot.name}: joints and blendshapes are {1000 * rms:.3g} mm RMS from the points that they stand "
            f"for, and vertex {worst[3]} at time code {worst[2]:g} is {1000 * worst[0]:.3g} mm off; "
            f"{1000 * tolerance.rms:g} mm and {1000 * tolerance.largest:g} mm are allowed."
        )
    return Verification(frames=len(times), largest_error_m=worst[0], allowed_error_m=worst[1], rms_error_m=rms)


def need_valid(path: Path, report: Reporter) -> None:
    """Report what a shot's checks find; raise `VerificationError` for an error among it.

    The checks are those of stages. A glTF binary is checked by reading it.
    """
    from ssilk_usd.checking.shot import check_shot

    if path.suffix == GLB:
        return
    findings = check_shot(path)
    for finding in findings:
        report(Message(str(finding), "warning"))
    errors = [finding for finding in findings if finding.severity == "error"]
    if errors:
        raise VerificationError(f"{path}: {len(errors)} checks failed, first at {errors[0].prim}: {errors[0].text}.")
