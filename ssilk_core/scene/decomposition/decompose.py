# SPDX-License-Identifier: Apache-2.0
"""Vertex trajectories as joints and blendshapes [cf. Le, Deng 2012].

Whoever made the vertices, the character's joints move as they do, so proxies and shapes are what is left to find.
Proxies turn and move: a frame of a proxy takes as many bytes as two vertices of a shape. Shapes alone would be more,
and so would shapes of what proxies alone miss. Therefore proxies are fitted together with a few principal components,
in turns with the components of what then is left. The final shapes are those that the tolerance needs
(`shapes.OffsetShapes`). What they reach is measured in the world, with the reference implementation of skinning.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import ceil
from typing import TYPE_CHECKING

import numpy as np

from ...errors import fail
from ..assets import Deformer, Floats, GarmentPose, Motion
from ..kinematics import deform, local_transforms, quaternion_from_matrix
from .poses import MAX_STEPS, PoseFitter, model_bounds
from .rest import FRAMES_PER_BLOCK, rest_residuals
from .shapes import BASIS_FRAMES, FitTolerance, OffsetShapes, components, evenly

if TYPE_CHECKING:
    import torch

SAMPLE = 512  # vertices that poses are fitted to; their weights are known, and shapes take the rest
COMPONENTS, FRAMES_EACH = 8, 48  # fitted together with the proxies, at most, and frames for each of them
FEW = 8  # frames, of which fewer get no components
ROUNDS, STEPS = 3, 1  # of fitting poses with components, and iterations in each
FIRST_STEPS = 6  # before them, where there are blendshapes to fit
SPREAD = 0.1  # [m] RMS of these components, which makes them as stiff as rotations
IN_MEMORY = 256 * 2**20  # bytes of offsets; more of them lie in a temporary file
LOCAL = 0.3  # of the vertices: a shape that moves fewer is local
ROUNDED = 1e-5  # [m] by which float32 may exceed the tolerance


@dataclass(frozen=True, eq=False)
class Decomposition:
    """A shot as joints and blendshapes.

    Attributes:
        deformer: with the shot's own blendshapes behind those that were there.
        poses: of all frames, consecutive.
        rms, largest: distance from the given vertices over all of them and all frames [m].
        own_shapes: blendshapes that the shot has added.
        local_shapes: those of them that move few vertices.
    """

    deformer: Deformer
    poses: tuple[GarmentPose, ...]
    rms: float
    largest: float
    own_shapes: int
    local_shapes: int


def decompose(
    deformer: Deformer,
    motion: Motion,
    points: Sequence[Floats],
    poses: Sequence[GarmentPose] | None = None,
    *,
    tolerance: FitTolerance | None = None,
    device: torch.device | str = "cpu",
) -> Decomposition:
    """Find rotations and translations of proxies, weights of the given blendshapes, and further blendshapes.

    Args:
        deformer: the garment. The last of its blendshapes, if it has any, keeps its constant weight.
        motion: of the character, at the frames of `points`.
        points: garment vertices of each frame in world space [m], shape (V, 3).
        poses: all frames to start from, such as a network's; None for proxies at rest.
        tolerance: `FitTolerance()` by default.
        device: where poses are fitted.

    Raises:
        SsilkError: other frames or vertices than the motion and the garment have, vertices that are not finite, or
            vertices that skinning cannot reach.
    """
    tolerance = tolerance or FitTolerance()
    _need_points(deformer, motion, points)
    pose = _PoseSearch(deformer, motion, points, tolerance, device).found(_whole(deformer, motion, poses))
    left = _offsets(deformer, motion, pose, points)
    own = OffsetShapes(left, tolerance)
    own.find()
    del left
    shapes, weights = own.all_shapes()
    found = replace(deformer, shapes=np.concatenate([deformer.shapes, shapes]))
    whole = GarmentPose(0, pose.rotations, np.concatenate([pose.weights, weights], axis=1), pose.translations)
    rms, largest, frame = _distance(found, motion, whole, points)
    if not (rms <= tolerance.rms + ROUNDED and largest <= tolerance.largest + ROUNDED):
        fail(
            motion.path,
            f"joints and blendshapes are {1000 * rms:.3g} mm RMS off the garment's points, and up to "
            f"{1000 * largest:.3g} mm in frame {frame}",
            f"{1000 * tolerance.rms:g} mm RMS and {1000 * tolerance.largest:g} mm at most are allowed",
            "the joints fold its skinning there; keep the points",
        )
    moved = [int(shape.any(axis=1).sum()) for shape in shapes]
    local = sum(count < LOCAL * deformer.scene.garment.mesh.vertex_count for count in moved)
    return Decomposition(found, tuple(_blocks(whole)), rms, largest, len(shapes), local)


def _need_points(deformer: Deformer, motion: Motion, points: Sequence[Floats]) -> None:
    if len(points) != motion.frame_count:
        fail(motion.path, f"{motion.frame_count} frames for {len(points)} of the garment's points", "each needs one")
    count = deformer.scene.garment.mesh.vertex_count
    for frame, each in enumerate(points):
        if each.shape != (count, 3):
            fail(motion.path, f"frame {frame} has points of shape {each.shape}", f"({count}, 3) is needed")
        if not np.isfinite(each).all():
            fail(motion.path, f"frame {frame} has NaN or infinity among the points", "all must be finite")


def _whole(deformer: Deformer, motion: Motion, poses: Sequence[GarmentPose] | None) -> GarmentPose | None:
    """Return consecutive poses as one, with weights of the deformer's blendshapes."""
    if poses is None:
        return None
    whole = GarmentPose.joined(poses)
    assert whole.frame_count == motion.frame_count
    return replace(whole, weights=whole.weights[:, : deformer.shape_count])


def _blocks(pose: GarmentPose) -> Iterator[GarmentPose]:
    for start in range(0, pose.frame_count, FRAMES_PER_BLOCK):
        yield pose.part(slice(start, start + FRAMES_PER_BLOCK))


class _PoseSearch:
    """Poses of proxies, and weights of the given blendshapes, that leave as few further shapes as possible."""

    def __init__(
        self,
        deformer: Deformer,
        motion: Motion,
        points: Sequence[Floats],
        tolerance: FitTolerance,
        device: torch.device | str,
    ) -> None:
        self.deformer, self.motion, self.points, self.tolerance = deformer, motion, points, tolerance
        self.device, self.proxies = device, deformer.scene.rig.proxy_count
        scene, count = deformer.scene, deformer.scene.garment.mesh.vertex_count
        self.rest = local_transforms(scene.bind_transforms, scene.parents)[scene.character.skeleton.joint_count :]
        drawn = np.random.default_rng(0).permutation(count)[:SAMPLE]
        self.sample, self.mass = np.sort(drawn), np.ones(count)

    def found(self, start: GarmentPose | None) -> GarmentPose:
        """Return the poses of all frames, from where to start or from proxies at rest.

        Given blendshapes are fitted with rotations alone, so that proxies do not run after what shapes hold.
        """
        bounds = model_bounds(self.deformer.shape_count)
        pose = self._at_rest() if start is None else start
        if not self.proxies and not (bounds[0] < bounds[1]).any():
            return pose
        frames = self.motion.frame_count
        count = min(COMPONENTS, ceil(frames / FRAMES_EACH)) if frames >= FEW else 0
        if self.deformer.shape_count and count:
            pose = self._fitted(self.deformer, pose, *bounds, steps=FIRST_STEPS)
        for _ in range(ROUNDS):
            left = self._left(pose)
            distance = np.linalg.norm(left, axis=-1)
            if np.sqrt((distance**2).mean()) < self.tolerance.rms and distance.max() < self.tolerance.largest:
                break
            if not count:
                return self._fitted(self.deformer, self._free_to_move(pose), *bounds)
            pose = self._with_components(pose, left, count)
        return pose

    def _at_rest(self) -> GarmentPose:
        rotations, frames = quaternion_from_matrix(self.rest[:, :3, :3]), self.motion.frame_count
        weights = np.mean(model_bounds(self.deformer.shape_count), axis=0)
        return GarmentPose(0, np.tile(rotations, (frames, 1, 1)), np.tile(weights, (frames, 1)))

    def _free_to_move(self, pose: GarmentPose) -> GarmentPose:
        """Return a pose whose proxies have translations, where there are proxies."""
        if not self.proxies or pose.translations is not None:
            return pose
        return replace(pose, translations=np.tile(self.rest[:, :3, 3], (pose.frame_count, 1, 1)))

    def _left(self, pose: GarmentPose) -> Floats:
        """Return what the sample lacks in the rest pose [m], shape (F, S, 3), float32."""
        found = rest_residuals(self.deformer, self.motion, pose, self.points, self.sample)
        return np.concatenate([offsets.astype(np.float32) for _, offsets in found])

    def _with_components(self, pose: GarmentPose, left: Floats, count: int) -> GarmentPose:
        """Return poses, whose proxies may move, fitted together with components of what they have left."""
        given, frames = self.deformer.shape_count, len(left)
        mean = left.mean(axis=0, dtype=np.float64)
        chosen = evenly(frames, BASIS_FRAMES)
        basis = components((left[chosen] - mean).reshape(len(chosen), -1), 0.0, len(self.sample))[:count]
        if not basis:  # what is left stays the same
            return pose
        pose = self._free_to_move(pose)
        scale = SPREAD * np.sqrt(len(self.sample))
        flat = np.stack(basis)
        weights = (left - mean.astype(np.float32)).reshape(frames, -1) @ (flat.T / scale).astype(np.float32)
        shapes = np.zeros((len(basis) + 1, len(self.mass), 3))
        shapes[:, self.sample] = [*(scale * flat).reshape(len(basis), -1, 3), mean]
        extended = replace(self.deformer, shapes=np.concatenate([self.deformer.shapes, shapes]))
        started = replace(pose, weights=np.concatenate([pose.weights, weights, np.ones((frames, 1))], axis=1))
        free = np.full(len(basis), np.inf)
        lower, upper = model_bounds(given)
        fitted = self._fitted(extended, started, np.concatenate([lower, -free, [1.0]]),
                              np.concatenate([upper, free, [1.0]]), steps=STEPS)  # fmt: skip
        return replace(fitted, weights=fitted.weights[:, :given])

    def _fitted(
        self, deformer: Deformer, pose: GarmentPose, lower: Floats, upper: Floats, steps: int = MAX_STEPS
    ) -> GarmentPose:
        fitter = PoseFitter(
            deformer, self.mass, vertices=self.sample, lower=lower, upper=upper, steps=steps, device=self.device
        )
        return GarmentPose.joined([fit.pose for fit in fitter.fit(self.motion, _blocks(pose), self.points)])


def _offsets(deformer: Deformer, motion: Motion, pose: GarmentPose, points: Sequence[Floats]) -> Floats:
    """Return what all vertices lack in the rest pose [m], shape (F, V, 3), float32; in a file where it is much."""
    shape = (motion.frame_count, deformer.scene.garment.mesh.vertex_count, 3)
    left: Floats
    if 4 * int(np.prod(shape)) <= IN_MEMORY:
        left = np.zeros(shape, np.float32)
    else:
        with tempfile.TemporaryFile() as file:  # its space is free again once the array is gone
            left = np.memmap(file, np.float32, "w+", shape=shape)
    for part, offsets in rest_residuals(deformer, motion, pose, points):
        left[part] = offsets
    return left


def _distance(
    deformer: Deformer, motion: Motion, whole: GarmentPose, points: Sequence[Floats]
) -> tuple[float, float, int]:
    """Return RMS and largest distance from points [m], and the frame of the latter."""
    squares, largest, worst, count = 0.0, 0.0, 0, 0
    for pose in _blocks(whole):
        for frame, vertices in enumerate(deform(deformer, motion, pose), start=pose.start):
            square = ((vertices - points[frame]) ** 2).sum(axis=-1)
            squares, count = squares + float(square.sum()), count + len(square)
            if square.max() > largest**2:
                largest, worst = float(np.sqrt(square.max())), frame
    return float(np.sqrt(squares / count)), largest, worst
