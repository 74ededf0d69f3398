# SPDX-License-Identifier: Apache-2.0
"""Rollouts whose frames are moved until, in the written file, nothing is wrong in them.

`certified` moves the frames of a rollout, before it is written. `proven` looks at the file itself: where its cloth is
still wrong, its frames get a shape each, then they are moved again, with more room between cloth and cloth.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from ....events import Countdown, Message, Reporter, silent
from ..beneath import GarmentsBeneath
from ..opened import add_provenance, open_shot
from ..rollout import BakeRollout
from .blendshapes import with_shapes
from .requirements import need_certifier
from .summary import CERTIFICATE, summary_of
from .work import CertificateWork, frames_of
from .written import faults_in

if TYPE_CHECKING:
    from ....physics.certify.faults import FrameFaults

ATTEMPTS = 4  # at moving what is wrong in the file
THICKER = 1.6  # in each after the second: room between cloth and cloth


def certified(
    rollout: BakeRollout, report: Reporter = silent, beneath: Mapping[str, Path] | None = None
) -> BakeRollout:
    """Return a rollout whose wrong frames are moved, or the rollout itself where its request does not ask for it.

    Args:
        beneath: files of garments that it is worn over in this shot, by their names. They stay as they are.

    Raises:
        SsilkError: a library is missing, or a garment beneath has other frames.
    """
    if not rollout.request.certify or rollout.certificate is not None:
        return rollout
    from ....physics.certify.certifier import Certifier

    need_certifier()
    poses = tuple(rollout.poses())
    points = [vertices for pose in poses for vertices in rollout.decode(pose)]
    below = GarmentsBeneath(beneath, rollout.request.samples_per_frame) if beneath else None
    if below:
        below.need_frames(rollout.motion.frame_count)
    certifier = Certifier(rollout.deformer.scene, below.faces if below else None)
    work = CertificateWork(rollout, certifier, frames_of(rollout, poses, points, below), below)
    if excused := len(work.certifier.finder.cloth.allowed):
        text = f"{excused} pairs of triangles that intersect in the bind pose, or that stitches join, do not count"
        report(Message(f"{rollout.deformer.scene.garment.mesh.path}: {text}", "warning"))
    over = f", of {', '.join(below.files)} beneath it too" if below else ""
    report(Message(f"looking for cloth that passes through cloth{over}, and for covered skin that shows"))
    faults = work.certifier.faults(work.frames, Countdown(work.frames.count, report))
    work.faulty = tuple(faults)
    if faults:
        report(Message(f"{len(faults)} of {work.frames.count} frames are moved"))
        moved = work.certifier.certify(work.frames, faults, Countdown(2 * len(faults), report))
        work.points.update(moved.points)
        work.caught.update(moved.left)
    return with_shapes(work, poses)


def proven(rollout: BakeRollout, path: Path, report: Reporter = silent) -> BakeRollout | None:
    """Look at the written file of a rollout; return one to write instead, or None and let the file say what it is.

    Raises:
        SsilkError: the file cannot be read, or written again.
    """
    certificate = rollout.certificate
    if certificate is None:
        return None
    work: CertificateWork = certificate.work
    work.attempts += 1
    shot, samples = open_shot(path), rollout.request.samples_per_frame
    found = dict(faults_in(shot, work.certifier, rollout, work.beneath, report))
    freed = {frame: faults for frame, faults in found.items() if frame not in work.caught}
    if freed and work.attempts < ATTEMPTS:
        if work.attempts > 1 or not work.exact.isdisjoint(freed) or not set(freed) <= set(work.points):
            _move_again(work, freed, report)
        work.exact |= set(freed)
        return with_shapes(work, certificate.poses_before)
    summary = summary_of(work, found, shot.sample_times(samples))
    certificate.summary = summary
    over = work.beneath.to_metadata(path.parent) if work.beneath else {}
    add_provenance(path, {CERTIFICATE: {**summary.to_metadata(), **over}})
    if summary.left:
        report(Message(f"{rollout.request.motion}: {summary.unfree}", "warning"))
    return None


def _move_again(work: CertificateWork, found: Mapping[int, FrameFaults], report: Reporter) -> None:
    """Move frames that are wrong in the file, from where they are there, with more room between cloth and cloth."""
    from ....physics.certify.settle import THICKNESS

    told, thickness = Countdown(len(found), report), THICKNESS * THICKER**work.attempts
    for frame in found:
        points, left = work.certifier.again(work.frames, frame, work.points.get(frame), thickness)
        work.points[frame] = points
        if left.count:
            work.caught.add(frame)
        told()
