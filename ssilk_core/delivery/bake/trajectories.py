# SPDX-License-Identifier: Apache-2.0
"""Vertex trajectories of any simulator as a shot of joints and blendshapes, verified like every bake."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ...errors import fail
from ...events import Message, Reporter, silent
from ...files import relative_path, replacing, sha256, split_location
from ...scene.assets import Deformer, Floats, Motion, Scene, Skeleton
from ...scene.kinematics import held_at_cuts, sample_motion
from ...scene.riders import Rider, RiderJoints
from ..targets import GLB
from .bodies import worn
from .counted import MetWorld, state_counts
from .glb import warn_of_sets, write_glb_shot
from .nearness import need_near
from .opened import open_shot
from .origin import met_metadata
from .result import SKINNED, BakeResult, ShotShapes, Verification
from .riders import verify_riders
from .verification import compare_trajectories, need_valid

if TYPE_CHECKING:
    from ssilk_usd.shots.shot import ShotSummary
    from ssilk_usd.shots.trajectories import MeshTrajectories
    from ssilk_usd.units import StageUnits

    from ...scene.decomposition import FitTolerance

SLACK = 1e-4  # frames of a motion by which rounded time codes may lie outside it


def rig_deformer(scene: Scene) -> Deformer:
    """Return a garment on the rig of its stage: no blendshapes, and weights as they are there."""
    return Deformer(scene, scene.rig.skin, np.zeros((0, scene.garment.mesh.vertex_count, 3)))


def trained_deformer(model: str | os.PathLike[str], stage: str | os.PathLike[str], root: str | None) -> Deformer:
    """Return a trained garment on the character of a stage, without its blendshapes.

    Raises:
        SsilkError: a file cannot be read, or the character is not the model's.
    """
    from ssilk_usd.opening.stage import open_stage

    from ...network.checkpoint import load_model, network

    on = worn(load_model(os.fspath(model)), open_stage(os.fspath(stage)), root)
    deformer = network(on.file, on.scene).deformer()
    return replace(deformer, shapes=deformer.shapes[:0])


def motion_at(motion: Motion, skeleton: Skeleton, cache: MeshTrajectories, where: str) -> Motion:
    """Return the character's motion at the frames of a cache; nothing is interpolated across a cut.

    Raises:
        SsilkError: the motion does not last from the first to the last of them.
    """
    seconds = cache.seconds
    position = seconds * motion.fps - motion.start
    if not (position[0] > -SLACK and position[-1] < motion.frame_count - 1 + SLACK):
        first, last = motion.start / motion.fps, (motion.start + motion.frame_count - 1) / motion.fps
        fail(
            motion.path,
            f"it lasts from {first:.6g} s to {last:.6g} s",
            f"{where} lasts from {seconds[0]:.6g} s to {seconds[-1]:.6g} s",
            "name the motion that the cache was simulated on",
        )
    near = np.round(position)
    position = np.where(np.abs(position - near) < SLACK, near, position).clip(0, motion.frame_count - 1)
    position = held_at_cuts(motion, skeleton, position)
    return Motion(motion.path, cache.fps, *sample_motion(motion, position), start=float(seconds[0]) * cache.fps)


def skin_trajectories(
    deformer: Deformer, motion: Motion, points: Sequence[Floats], output: str | os.PathLike[str], *,
    units: StageUnits, origin: Mapping[str, object], about: Mapping[str, object] | None = None,
    riders: Sequence[Rider] = (), met: MetWorld | None = None, hidden: Sequence[tuple[int, bool]] = (),
    include_body: bool = True, verify: bool = True, tolerance: FitTolerance | None = None, device: str = "cpu",
    source: str = "the garment's points", report: Reporter = silent,
) -> BakeResult:  # fmt: skip
    """Write vertex trajectories as joints and blendshapes into one file, which appears once it is verified.

    Args:
        deformer: the garment on its character; the shot has its blendshapes and as many more as it needs.
        motion: of the character, at the frames of `points`; its start is the time code of the first one.
        points: garment vertices of each frame in world space [m], shape (V, 3).
        units: units and up axis of the file.
        origin: where the points come from, as the file says it; without a cache it cannot be compared again.
        about: what else the file says of itself.
        riders: what rides on the garment.
        met: what surrounds the character; cloth in its colliders is counted.
        hidden: from which frames on the garment is hidden (True) or seen (False).
        tolerance: how near joints and blendshapes come to the points; `FitTolerance()` by default.
        source: what the points come from, for messages.

    Raises:
        SsilkError: points of another garment or motion, points far from the skinned garment in every frame or that
            skinning cannot reach, or an output that cannot be written.
        VerificationError: the file is not what was computed; it is not kept.
    """
    from ssilk_usd.writing.export import packaged

    from ...devices import select_device
    from ...scene.decomposition import FitTolerance, decompose

    path, tolerance = Path(output), tolerance or FitTolerance()
    need_near(deformer, motion, points, source, report)
    found = decompose(deformer, motion, points, tolerance=tolerance, device=select_device(device))
    shapes = ShotShapes.of(found)
    if path.suffix == GLB:
        warn_of_sets(found.deformer, path, report)
    said = {**(about or {}), SKINNED: {**origin, **asdict(tolerance), **shapes.to_metadata()}}
    said |= met_metadata(met.world, path) if met else {}
    ridden = RiderJoints(found.deformer, riders, found.deformer.skin.indices.shape[1])
    with replacing(path) as unverified:
        with packaged(unverified, report, name=path) as layer:
            write = _writer(path, units)
            summary = write(
                layer, ridden.deformer, motion, ridden.poses(motion, found.poses), start=motion.start,
                include_body=include_body, hidden=hidden, provenance=said, riders=ridden,
            )  # fmt: skip
            name = Path(split_location(motion.path)[0]).stem
            counts = state_counts(
                layer, found.deformer.scene, motion, name=name, device=device, met=met, riders=riders
            )
        verification = _verified(unverified, points, tolerance, ridden, report) if verify else None
        if not verify:
            report(Message("not verified, as asked", "warning"))
    if summary.left_out:
        report(Message(f"{path}: {summary.left_out}", "warning"))
    return BakeResult(
        path=path, frames=summary.frame_count, fps=summary.fps, joints=summary.joint_count,
        proxies=summary.proxy_count - len(ridden.names), blendshapes=summary.shape_count,
        size_bytes=path.stat().st_size,
        verification=verification, shapes=shapes, shown_skin=counts.shown_skin,
        intersections=counts.intersections, sunk=counts.sunk, entered=counts.entered,
    )  # fmt: skip


def _writer(path: Path, units: StageUnits) -> Callable[..., ShotSummary]:
    """Return what writes a shot into a file of its suffix."""
    from ssilk_usd.shots.shot import write_shot

    return write_glb_shot if path.suffix == GLB else partial(write_shot, units=units)


def _verified(
    path: Path, points: Sequence[Floats], tolerance: FitTolerance, ridden: RiderJoints, report: Reporter
) -> Verification:
    """Return how far a written file is off the points; raise `VerificationError` where it is too far."""
    need_valid(path, report)
    shot = open_shot(path)
    verification = compare_trajectories(shot, points, tolerance=tolerance)
    verify_riders(shot, shot.sample_times(), ridden, report)
    return verification


def cache_origin(cache: str, mesh: str, output: Path) -> dict[str, object]:
    """Return what a shot says of the cache that it was made from, so that it is found again."""
    file = split_location(cache)[0]
    return {
        "cache": relative_path(file, output.absolute().parent) or Path(file).name,
        "mesh": mesh,
        "cache_sha256": sha256(Path(file)),
    }
