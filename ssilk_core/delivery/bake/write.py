# SPDX-License-Identifier: Apache-2.0
"""One garment over one motion as one file."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...errors import fail
from ...events import Message, Reporter, Result, Started, silent
from ...files import need_not_input, need_writable, replacing, split_location
from ...scene.kinematics import lbs_deformer, lbs_poses
from ...scene.riders import RiderJoints
from ..targets import GLB, check_suffix
from .beneath import left_out, tell_left_out
from .certificate.certified import certified, proven
from .certificate.requirements import need_certifier
from .counted import state_rollout_counts
from .glb import warn_of_sets, write_glb_shot
from .hiding import hidden_polygons_of
from .latents import solved
from .layered import tell_over
from .origin import shot_metadata
from .refinement import refined
from .request import BakeRequest, need_body, split_start
from .result import BakeResult, Verification
from .riders import need_joints
from .rollout import BakeRollout
from .sizing import load_sized
from .stated import ShotCounts
from .verification import verify_file

if TYPE_CHECKING:
    from ssilk_usd.shots.shot import ShotSummary
    from ssilk_usd.writing.body_faces import HiddenPolygons


def bake(
    request: BakeRequest,
    output: str | os.PathLike[str],
    *,
    quality: str | None = None,
    budget: str | None = None,
    include_body: bool = True,
    verify: bool = True,
    report: Reporter = silent,
    place: Path | None = None,
    beneath: Mapping[str, Path] | None = None,
) -> BakeResult:
    """Bake one garment over one motion into one file, which appears once it is verified.

    Args:
        output: the file; its suffix is one that the request's target takes.
        quality: level of quality, a name in `ssilk_core.quality.levels.QUALITIES`.
        budget: keep the most of the garment within "0.3ms" for each frame, or "2MB" for the file.
        include_body: write the character's body meshes as well.
        verify: re-skin the file by UsdSkel and compare it with the decoder's own vertices.
        report: takes events.
        place: the file that this one becomes a part of, from which inputs are named; `output` by default.
        beneath: files of garments that it is refined and certified over, by name, where the request asks for that.

    Raises:
        SsilkError: an input is missing or does not fit, or the file cannot be written.
        VerificationError: the file is not what was computed; it is not kept, and an older one stays.
    """
    path = Path(output)
    _check_output(request, Path(place or path))
    need_body(request, include_body)
    if request.certify:
        need_certifier()
    rollout = load_sized(
        request, quality=quality, budget=budget, suffix=path.suffix, include_body=include_body, report=report
    )
    if request.writes_points:
        need_joints(rollout.riders)
    report(Started("bake", rollout.motion.frame_count, {"output": str(path)}))
    rollout.tell(report)
    if rollout.request.meets_beneath:
        over: Any = rollout.provenance.get("trained_over", {})
        if over and (missing := left_out(over, (beneath or {}).values())):
            where = f"{place}: {path.stem}" if place else str(path)
            tell_left_out(where, missing, rollout.request.made, report)
    rollout = certified(refined(solved(rollout, report), report, beneath=beneath), report, beneath)
    if path.suffix == GLB:
        warn_of_sets(rollout.deformer, Path(place or path), report)
    rollout, hidden, summary, counts, verification = _write_verified(
        rollout, path, include_body, verify, report, place or path
    )
    if summary.left_out:
        report(Message(f"{place or path}: {summary.left_out}", "warning"))
    result = result_of(rollout, path, summary, counts, verification, hidden)
    rollout.warn(report)
    report(Result("bake", result.figures()))
    if beneath and not place:
        tell_over(path, beneath, report)
    return result


def result_of(
    rollout: BakeRollout,
    path: Path,
    summary: ShotSummary,
    counts: ShotCounts,
    verification: Verification | None,
    hidden: HiddenPolygons | None,
) -> BakeResult:
    """Return the result of a rollout that was written."""
    return BakeResult(
        path=path,
        frames=summary.frame_count,
        fps=summary.fps,
        joints=summary.joint_count,
        proxies=summary.proxy_count - sum(rider.attachment is not None for rider in rollout.riders),
        blendshapes=summary.shape_count,
        size_bytes=path.stat().st_size,
        verification=verification,
        reduction=rollout.reduction,
        refinement=rollout.refinement.summary if rollout.refinement else None,
        latent=rollout.latents.summary if rollout.latents else None,
        loop=rollout.loop_summary,
        hidden_faces=None if hidden is None else sum(int(mask.sum()) for mask in hidden.masks),
        recovered=tuple(rollout.recovered),
        shown_skin=counts.shown_skin,
        intersections=counts.intersections,
        sunk=counts.sunk,
        entered=counts.entered,
        certificate=rollout.certificate.summary if rollout.certificate else None,
    )


def _check_output(request: BakeRequest, path: Path) -> None:
    """Raise `SsilkError` where the target does not take the file, or it cannot be written."""
    check_suffix(path, request.target)
    if path.suffix == GLB and request.writes_points:
        fail(str(path), "refined points", "a glb holds joints and morph targets", "use --refined-output joints")
    need_writable(path)
    start = request.start_cloth and split_location(split_start(request.start_cloth)[0])[0]
    need_not_input(path, request.model, request.stage, split_location(request.motion)[0], start)


def _write_verified(
    rollout: BakeRollout,
    output: Path,
    include_body: bool,
    verify: bool,
    report: Reporter,
    place: Path,
) -> tuple[BakeRollout, HiddenPolygons | None, ShotSummary, ShotCounts, Verification | None]:
    """Write a file that appears once it is verified; return the rollout that it holds, what is hidden, and what was
    found in it."""
    from ssilk_usd.writing.export import packaged

    with replacing(output) as unverified:
        with packaged(unverified, report, name=output) as layer:
            hidden = hidden_polygons_of(rollout, report)
            summary = _write(layer, rollout, output, include_body, hidden, place)
            while again := proven(rollout, layer, report):
                rollout, hidden = again, hidden_polygons_of(again, report)
                summary = _write(layer, rollout, output, include_body, hidden, place)
            counts = state_rollout_counts(layer, rollout)
        if not verify:
            report(Message("not verified, as asked", "warning"))
        verification = verify_file(rollout, unverified, report) if verify else None
        return rollout, hidden, summary, counts, verification


def _write(
    layer: Path,
    rollout: BakeRollout,
    output: Path,
    include_body: bool,
    hidden: HiddenPolygons | None,
    place: Path,
) -> ShotSummary:
    """Write a shot of joints and blendshapes, or of refined points."""
    from ssilk_usd.shots.points import point_cache
    from ssilk_usd.shots.shot import write_shot

    common: dict[str, Any] = {
        "start": rollout.start,
        "samples_per_frame": rollout.request.samples_per_frame,
        "include_body": include_body,
        "hidden": rollout.hidden,
        "hidden_polygons": hidden,
        "provenance": shot_metadata(rollout, place, output),
    }
    riders = rollout.rider_joints()
    poses = riders.poses(rollout.motion, rollout.poses())
    if output.suffix == GLB:
        return write_glb_shot(layer, riders.deformer, rollout.motion, poses, riders=riders, **common)
    common |= {"units": rollout.units, "record": rollout.played or rollout.record, "info": rollout.info}
    if not rollout.request.writes_points:
        return write_shot(layer, riders.deformer, rollout.motion, poses, riders=riders, **common)
    if rollout.riders:
        unposed = RiderJoints(lbs_deformer(rollout.deformer.scene), rollout.riders)
        poses = unposed.poses(rollout.motion, lbs_poses(rollout.motion.frame_count), rollout.points())
        common |= {"riders": unposed, "skinned": (unposed.deformer, poses)}
    with point_cache(layer, rollout.deformer.scene, rollout.motion, **common) as cache:
        for frame, points in enumerate(rollout.points()):
            cache.write(frame, points)
    return cache.shot
