# SPDX-License-Identifier: Apache-2.0
"""Displacements as blendshapes of the shot's own: each belongs to one run of frames and weighs nothing elsewhere.

All other frames are those of the same bake without a certificate. Where shapes with fewer components than frames miss
too much, frames get a shape each.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from ....scene.assets import Floats, GarmentPose
from ..computed_frames import Certificate
from ..rollout import BakeRollout
from .work import CertificateWork

RMS, LARGEST = 1e-5, 4e-5  # [m] by which blendshapes may miss displacements, a tenth of the room
SHAPE_BYTES, VERTEX_BYTES, WEIGHT_BYTES = 300, 16, 4  # of a blendshape, of each of its vertices, and of a weight


def with_shapes(work: CertificateWork, poses: tuple[GarmentPose, ...]) -> BakeRollout:
    """Return the rollout with blendshapes that move its frames, each within a run of these."""
    from ....physics.certify.certifier import runs

    deformer, count = work.base.deformer, work.frames.count
    vertices = deformer.scene.garment.mesh.vertex_count
    shapes, weights = [np.zeros((0, vertices, 3), np.float32)], [np.zeros((count, 0), np.float32)]
    for first, last in parts_of(runs(work.points), work.exact):
        offsets = _rest_offsets(work, poses, first, last)
        own, shares = shapes_of(offsets, exact=first in work.exact)
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


def parts_of(spans: Sequence[tuple[int, int]], exact: set[int]) -> Iterator[tuple[int, int]]:
    """Yield parts of spans whose frames all have a shape each, or none has."""
    for first, last in spans:
        begin = first
        for frame in range(first + 1, last + 2):
            if frame > last or (frame in exact) != (begin in exact):
                yield begin, frame - 1
                begin = frame


def _rest_offsets(work: CertificateWork, poses: Sequence[GarmentPose], first: int, last: int) -> Floats:
    """Return displacements in the rest pose [m], shape (F, V, 3), of frames from a first to a last."""
    from ....scene.decomposition.rest import rest_residuals

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


def shapes_of(offsets: Floats, *, exact: bool) -> tuple[Floats, Floats]:
    """Return shapes [m] (K, V, 3) and weights (F, K) of displacements in a run of frames (F, V, 3), the fewest bytes.

    Args:
        exact: one shape for each frame, which misses nothing.
    """
    from ....scene.decomposition import FitTolerance
    from ....scene.decomposition.shapes import OffsetShapes

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
