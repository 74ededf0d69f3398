# SPDX-License-Identifier: Apache-2.0
"""Written shots compared with what was computed."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from ..errors import VerificationError
from ..events import Message, Reporter, Result, Started, silent
from ..targets import GLB
from .load import load_rollout
from .opened import open_shot
from .origin import read_origin
from .refinement import refined, verify_energies
from .result import Verification
from .rollout import BakeRollout


def verify(
    shot: str | os.PathLike[str],
    *,
    model: str | os.PathLike[str] | None = None,
    stage: str | os.PathLike[str] | None = None,
    motion: str | os.PathLike[str] | None = None,
    device: str | None = None,
    report: Reporter = silent,
) -> Verification:
    """Check a baked shot and compare it, re-skinned by UsdSkel alone, with the decoder's own vertices.

    Args:
        shot: file written by `bake`, or animation layer written by `bake_layers`.
        model, stage, motion: new path of an input that has moved, and not together with the shot.
        device: where the network runs; None for where it ran for the bake.
        report: takes events.

    Raises:
        SsilkError: the shot was not baked here, or an input is missing or does not fit.
        VerificationError: a check fails, or a vertex is further off than allowed.
    """
    path = Path(shot)
    origin = read_origin(path, {"model": model, "stage": stage, "motion": motion})
    rollout = load_rollout(replace(origin.request, device=device or origin.request.device))
    for name, then in origin.hashes.items():
        if then != rollout.provenance[f"{name}_sha256"]:
            text = f"{getattr(origin.request, name)}: the {name} has changed since the shot was baked from it"
            report(Message(text, "warning"))
    report(Started("verify", rollout.motion.frame_count, {"shot": str(path)}))
    found = verify_file(rollout, path, report)
    report(Result("verify", {"shot": str(path), **found.figures()}))
    return found


def verify_file(rollout: BakeRollout, path: Path, report: Reporter) -> Verification:
    """Check a file and compare it, re-skinned by its format's rules alone, with the rollout that it should hold.

    Points of an earlier refinement are compared by energy (`verify_energies`), unless the rollout has its own.

    Raises:
        VerificationError: a check fails, or a vertex is further off than allowed.
    """
    from ssilk_usd.check import compare_points

    _check(path, report)
    shot, samples = open_shot(path), rollout.request.samples_per_frame
    times = shot.sample_times(samples)
    if not shot.is_skinned and rollout.request.refine and rollout.refinement is None:
        return verify_energies(rollout, map(shot.garment_points, times), report)
    if not rollout.request.writes_points:
        rollout = refined(rollout)
    expected = rollout.vertices(report) if shot.is_skinned else rollout.points(report)
    found = compare_points(shot, expected, samples_per_frame=samples)
    if not found.passed:
        raise VerificationError(
            f"{path}: vertex {found.vertex} at time code {found.time:g} is {found.worst:.3g} m from where the "
            f"decoder has it; at most {found.bound:.3g} m is allowed, wherever it is; bake it again, closer to the "
            "origin if it is many kilometres away."
        )
    return Verification(frames=len(times), largest_error_m=found.worst, allowed_error_m=found.bound)


def _check(path: Path, report: Reporter) -> None:
    """Report what a shot's checks find; raise `VerificationError` for an error among it.

    The checks are USD's and those of stages. A glTF binary is checked by reading it.
    """
    from ssilk_usd.check import check_shot

    if path.suffix == GLB:
        return
    findings = check_shot(path)
    for finding in findings:
        report(Message(str(finding), "warning"))
    errors = [finding for finding in findings if finding.severity == "error"]
    if errors:
        raise VerificationError(f"{path}: {len(errors)} checks failed, first at {errors[0].prim}: {errors[0].text}.")
