# SPDX-License-Identifier: Apache-2.0
"""Bakes with a certificate: in the written file no triangle intersects another, and no covered skin shows.

`certified` moves the frames of a rollout that are wrong (`physics.certify`) and puts their displacements into
blendshapes of the shot's own. Each belongs to one run of frames and weighs nothing elsewhere, so all other frames are
those of the same bake without a certificate. `proven` looks at the file itself. Where shapes with fewer components
than frames miss too much, frames get a shape each; where the file's cloth is still wrong, they are moved again, with
more room between cloth and cloth.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ...errors import VerificationError, fail
from ...events import Countdown, Message, Reporter, silent
from ...physics.intersections.pairs import need_predicates
from ...scene.assets import Floats, GarmentPose
from ...scene.kinematics import body_at_rest, motion_transforms, skin_points, skinning_matrices, split_at_cuts
from .opened import add_provenance, open_shot, provenance_of
from .result import CertificateSummary, FrameSpan, certified_frames
from .rollout import BakeRollout, Certificate

if TYPE_CHECKING:
    from ssilk_usd.shots.play import Shot

    from ...physics.certify.certifier import Certifier, Frames
    from ...physics.certify.faults import FrameFaults
    from ..gltf.play import GlbShot
    from ..view.player import ShotPlayer

CERTIFICATE = "certificate"  # what a shot says of it, under this name
NEEDED = ("ipctk", "scipy")
ATTEMPTS = 4  # at moving what is wrong in the file
THICKER = 1.6  # in each after the second: room between cloth and cloth
RMS, LARGEST = 1e-5, 4e-5  # [m] by which blendshapes may miss displacements, a tenth of the room
SHAPE_BYTES, VERTEX_BYTES, WEIGHT_BYTES = 300, 16, 4  # of a blendshape, of each of its vertices, and of a weight


def need_certifier() -> None:
    """Check that frames can be certified, before work that ends in it.

    Raises:
        SsilkError: a library is missing, or cannot be loaded.
    """
    need_predicates()
    allowed = "--certify moves cloth by continuous tests of ipctk"
    missing = [name for name in NEEDED if find_spec(name) is None]
    if missing:
        fail("--certify", f"{', '.join(missing)} not installed", allowed, "pip install 'ssilk[certify]'")
    for name in NEEDED:
        try:
            import_module(name)
        except ImportError as error:  # such as a wheel of another machine
            fail("--certify", f"{name} cannot be loaded: {error}", allowed, "pip install --force-reinstall ipctk")


@dataclass(eq=False)
class CertificateWork:
    """What a certificate is made with, kept from one attempt to the next."""

    base: BakeRollout
    certifier: Certifier
    frames: Frames
    attempts: int = 0  # how often the file has been looked at
    exact: set[int] = field(default_factory=set)  # frames with a shape each
    caught: set[int] = field(default_factory=set)  # frames in which nothing free was found
    points: dict[int, Floats] = field(default_factory=dict)  # of frames that are moved
    faulty: tuple[int, ...] = ()


def certified(rollout: BakeRollout, report: Reporter = silent) -> BakeRollout:
    """Return a rollout whose wrong frames are moved, or the rollout itself where its request does not ask for it.

    Raises:
        SsilkError: a library is missing.
    """
    if not rollout.request.certify or rollout.certificate is not None:
        return rollout
    from ...physics.certify.certifier import Certifier

    need_certifier()
    poses = tuple(rollout.poses())
    points = [vertices for pose in poses for vertices in rollout.decode(pose)]
    work = CertificateWork(rollout, Certifier(rollout.deformer.scene), _frames(rollout, poses, points))
    if excused := len(work.certifier.finder.cloth.allowed):
        text = f"{excused} pairs of triangles that intersect in the bind pose, or that stitches join, do not count"
        report(Message(f"{rollout.deformer.scene.garment.mesh.path}: {text}", "warning"))
    report(Message("looking for cloth that passes through cloth, and for covered skin that shows"))
    faults = work.certifier.faults(work.frames, Countdown(work.frames.count, report))
    work.faulty = tuple(faults)
    if faults:
        report(Message(f"{len(faults)} of {work.frames.count} frames are moved"))
        found = work.certifier.certify(work.frames, faults, Countdown(2 * len(faults), report))
        work.points.update(found.points)
        work.caught.update(found.left)
    return _with_shapes(work, poses)


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
    found = dict(_faults_in(shot, work.certifier, rollout, samples, report))
    freed = {frame: faults for frame, faults in found.items() if frame not in work.caught}
    if freed and work.attempts < ATTEMPTS:
        if work.attempts > 1 or not work.exact.isdisjoint(freed) or not set(freed) <= set(work.points):
            _move_again(work, freed, report)
        work.exact |= set(freed)
        return _with_shapes(work, certificate.poses_before)
    summary = _summary(work, found, shot.sample_times(samples))
    certificate.summary = summary
    add_provenance(path, {CERTIFICATE: summary.to_metadata()})
    if summary.left:
        report(Message(f"{rollout.request.motion}: {summary.unfree}", "warning"))
    return None


@dataclass(frozen=True)
class CheckedCertificate:
    """A certificate that a file says of itself, and what was counted in it again.

    Attributes:
        moved: frames that it says were moved.
        said, counted: what the file says, and what was found in it now, in the same words.
    """

    moved: frozenset[int]
    said: str
    counted: str


def verify_certificate(rollout: BakeRollout, path: Path, report: Reporter = silent) -> CheckedCertificate:
    """Check that the frames of a file are as free as it says; return what it says and what was counted.

    Raises:
        VerificationError: it does not say how free it is, or another frame is not.
    """
    from ...physics.certify.certifier import Certifier

    need_certifier()
    said = provenance_of(path).get(CERTIFICATE)
    if not isinstance(said, Mapping):
        raise VerificationError(f"{path}: it was baked with --certify, but has no certificate; bake it again.")
    moved, left = (_frames_said(said.get(name, ())) for name in ("moved frames", "frames left"))
    shot, samples = open_shot(path), rollout.request.samples_per_frame
    times, intersecting, showing = shot.sample_times(samples), 0, 0
    for frame, faults in _faults_in(shot, Certifier(rollout.deformer.scene), rollout, samples, report):
        intersecting, showing = intersecting + (len(faults.pairs) > 0), showing + (len(faults.skin) > 0)
        if frame not in left:
            raise VerificationError(
                f"{path}: {len(faults.pairs)} pairs of triangles intersect and {len(faults.skin)} points of covered "
                f"skin show at time code {times[frame]:g}, where its certificate says that none does."
            )
    counted = certified_frames(len(times), intersecting, showing)
    return CheckedCertificate(frozenset(moved), str(said.get("found", "nothing")), counted)


def _frames_said(said: object) -> set[int]:
    """Return the frames of spans such as "3 to 5" that a file lists."""
    spans = [str(each).split(" to ") for each in said] if isinstance(said, Iterable) else []
    return {frame for first, last in spans for frame in range(int(first), int(last) + 1)}


def _frames(rollout: BakeRollout, poses: Sequence[GarmentPose], points: Sequence[Floats]) -> Frames:
    """Return the frames of a rollout, of which its bodies and turns are computed when they are asked for."""
    from ...physics.certify.certifier import Frames
    from ...scene.decomposition.rest import turns

    scene, motion = rollout.deformer.scene, rollout.motion
    skeleton = scene.character.skeleton
    joints = skinning_matrices(motion_transforms(motion, skeleton.parents), skeleton.bind_transforms)
    body = scene.character.merged_body() if scene.character.bodies else None
    starts = np.array([pose.start for pose in poses])

    def body_at(frame: int) -> Floats | None:
        if body is None:
            return None
        rest = body_at_rest(scene.character, motion, slice(frame, frame + 1))
        return skin_points(rest, body.skin, joints[frame : frame + 1])[0]

    def turns_at(frame: int) -> Floats:
        pose = poses[int(np.searchsorted(starts, frame, side="right")) - 1]
        return turns(rollout.deformer, motion, pose.part(slice(frame - pose.start, frame - pose.start + 1)))[0]

    spans = split_at_cuts(motion, skeleton)
    cuts = np.cumsum([span.frame_count for span in spans])[:-1]
    return Frames(motion.frame_count, motion.fps, points.__getitem__, body_at, turns_at, frozenset(cuts.tolist()))


def _with_shapes(work: CertificateWork, poses: tuple[GarmentPose, ...]) -> BakeRollout:
    """Return the rollout with blendshapes that move its frames, each within a run of these."""
    from ...physics.certify.certifier import runs

    deformer, count = work.base.deformer, work.frames.count
    vertices = deformer.scene.garment.mesh.vertex_count
    shapes, weights = [np.zeros((0, vertices, 3), np.float32)], [np.zeros((count, 0), np.float32)]
    for first, last in _parts(runs(work.points), work.exact):
        offsets = _rest_offsets(work, poses, first, last)
        own, shares = _shapes_of(offsets, exact=first in work.exact)
        whole = np.zeros((count, len(own)), np.float32)
        whole[first : last + 1] = shares
        shapes.append(own)
        weights.append(whole)
    found, together = np.concatenate(shapes), np.concatenate(weights, axis=1)
    extended = tuple(
        replace(pose, weights=np.concatenate([pose.weights, together[pose.start : pose.start + pose.frame_count]], 1))
        for pose in poses
    )
    larger = replace(deformer, shapes=np.concatenate([deformer.shapes, found]))
    held = Certificate(extended, poses, frozenset(work.points), deformer, work)
    return replace(work.base, deformer=larger, certificate=held)


def _parts(spans: Sequence[tuple[int, int]], exact: set[int]) -> Iterator[tuple[int, int]]:
    """Yield parts of spans whose frames all have a shape each, or none has."""
    for first, last in spans:
        begin = first
        for frame in range(first + 1, last + 2):
            if frame > last or (frame in exact) != (begin in exact):
                yield begin, frame - 1
                begin = frame


def _rest_offsets(work: CertificateWork, poses: Sequence[GarmentPose], first: int, last: int) -> Floats:
    """Return displacements in the rest pose [m], shape (F, V, 3), of frames from a first to a last."""
    from ...scene.decomposition.rest import rest_residuals

    deformer, motion = work.base.deformer, work.base.motion.clip(first, last + 1)
    parts = [
        pose.part(slice(max(first - pose.start, 0), max(last + 1 - pose.start, 0)))
        for pose in poses
        if pose.start <= last and pose.start + pose.frame_count > first
    ]
    whole = replace(GarmentPose.joined(parts), start=0)
    points = [work.points[frame] for frame in range(first, last + 1)]
    offsets = np.concatenate([some for _, some in rest_residuals(deformer, motion, whole, points)])
    for at, frame in enumerate(range(first, last + 1)):
        offsets[at][(points[at] == work.frames.points(frame)).all(axis=1)] = 0  # rounding of two decoders
    return offsets


def _shapes_of(offsets: Floats, *, exact: bool) -> tuple[Floats, Floats]:
    """Return shapes [m] (K, V, 3) and weights (F, K) of displacements in a run of frames (F, V, 3), the fewest bytes.

    Args:
        exact: one shape for each frame, which misses nothing.
    """
    from ...scene.decomposition import FitTolerance
    from ...scene.decomposition.shapes import OffsetShapes

    frames, vertices = offsets.shape[:2]
    each = offsets.astype(np.float32), np.eye(frames, dtype=np.float32)
    rows = np.flatnonzero(offsets.any(axis=(0, 2)))
    if exact or frames == 1 or not len(rows):
        return each
    found = OffsetShapes(offsets[:, rows].astype(np.float32), FitTolerance(rms=RMS, largest=LARGEST))
    found.find()
    shapes, weights = found.all_shapes()
    whole = np.zeros((len(shapes), vertices, 3), np.float32)
    whole[:, rows] = shapes
    return (whole, weights) if _bytes(whole, frames) < _bytes(each[0], frames) else each


def _bytes(shapes: Floats, frames: int) -> int:
    return len(shapes) * (SHAPE_BYTES + WEIGHT_BYTES * frames) + VERTEX_BYTES * int(shapes.any(axis=2).sum())


def _move_again(work: CertificateWork, found: Mapping[int, FrameFaults], report: Reporter) -> None:
    """Move frames that are wrong in the file, from where they are there, with more room between cloth and cloth."""
    from ...physics.certify.settle import THICKNESS

    told, thickness = Countdown(len(found), report), THICKNESS * THICKER**work.attempts
    for frame in found:
        points, left = work.certifier.again(work.frames, frame, work.points.get(frame), thickness)
        work.points[frame] = points
        if left.count:
            work.caught.add(frame)
        told()


def _faults_in(
    shot: Shot | GlbShot, certifier: Certifier, rollout: BakeRollout, samples: int, report: Reporter
) -> Iterator[tuple[int, FrameFaults]]:
    """Yield the frames of a file in which something is wrong, as its own joints and blendshapes pose it."""
    from .counted import body_in

    scene, motion = rollout.deformer.scene, rollout.motion
    skeleton = scene.character.skeleton
    player: ShotPlayer = shot
    garment = next(number for number, mesh in enumerate(player.meshes) if mesh.is_garment)
    bodies = body_in(shot, scene) if scene.character.bodies else None
    merged = scene.character.merged_body() if scene.character.bodies else None
    joints = skinning_matrices(motion_transforms(motion, skeleton.parents), skeleton.bind_transforms)
    times = shot.sample_times(samples)
    told = Countdown(len(times), report)
    for frame, time in enumerate(times):
        posed = shot.points(time)
        body: Floats | None = None
        if bodies is not None:
            body = np.concatenate([posed[number] for number in bodies])
        elif merged is not None:
            rest = body_at_rest(scene.character, motion, slice(frame, frame + 1))
            body = skin_points(rest, merged.skin, joints[frame : frame + 1])[0]
        faults = certifier.finder.find(posed[garment], certifier.finder.place(body))
        if faults.count:
            yield frame, faults
        told()


def _summary(work: CertificateWork, found: Mapping[int, FrameFaults], times: Sequence[float]) -> CertificateSummary:
    """Return what the certificate says."""
    from ...physics.certify.certifier import runs

    away = {
        frame: np.linalg.norm(points - work.frames.points(frame), axis=1) for frame, points in work.points.items()
    }
    moved = np.concatenate([each[each > 0] for each in away.values()]) if away else np.zeros(0)
    spans = tuple(FrameSpan(*each) for each in runs(found))
    reasons = tuple(_reason(work, [found[frame] for frame in range(span.first, span.last + 1)]) for span in spans)
    return CertificateSummary(
        frames=work.frames.count,
        faulty=len(work.faulty),
        moved=tuple(FrameSpan(*each) for each in runs(work.points)),
        intersecting=sum(len(faults.pairs) > 0 for faults in found.values()),
        showing=sum(len(faults.skin) > 0 for faults in found.values()),
        left=spans,
        codes=tuple((float(times[span.first]), float(times[span.last])) for span in spans),
        reasons=reasons,
        mean_mm=1000 * float(moved.mean()) if len(moved) else 0.0,
        largest_mm=1000 * float(moved.max()) if len(moved) else 0.0,
    )


def _reason(work: CertificateWork, faults: Sequence[FrameFaults]) -> str:
    """Return what is wrong in consecutive frames, and where."""
    scene = work.base.deformer.scene
    cloth, names = work.certifier.finder.cloth, scene.character.skeleton.joint_names
    regions: Counter[int] = Counter()
    pairs, points = max(len(each.pairs) for each in faults), max(len(each.skin) for each in faults)
    for each in faults:
        if cloth.regions is not None:
            regions.update(cloth.regions[each.pairs.reshape(-1)].tolist())
        regions.update(work.certifier.finder.joints[each.skin.index].tolist())
    where = names[regions.most_common(1)[0][0]].rpartition("/")[2]
    first = next((int(each.pairs[0, 0]) for each in faults if len(each.pairs)), None)
    said = [f"up to {pairs} pairs of triangles, such as with triangle {first}"] if first is not None else []
    said += [f"up to {points} points of skin"] if points else []
    return f"{' and '.join(said)} beside {where}"
