# SPDX-License-Identifier: Apache-2.0
"""Posed characters for the simulator, and the spans of their motions between cuts."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ...scene.assets import BodyShape, Floats, Ints, Motion, Scene, Skeleton
from ...scene.kinematics import (
    frames_at,
    local_transforms,
    matrix_from_quaternion,
    quaternion_from_matrix,
    rigid,
    sample_motion,
    sample_shapes,
    skinning_matrices,
    slerp,
    split_at_cuts,
    world_transforms,
)
from ..collision import CollisionBody, LimbAxes, PosedBody
from ..framed import Framed
from ..skinning import blend_matrices, transform_points
from ..world.surroundings import PosedWorld


@dataclass(frozen=True, eq=False)
class MotionSpan:
    """A part of a shot without cuts, sampled at the solver's steps.

    Attributes:
        shot: index of its motion.
        first: its first frame in the shot.
        substeps: steps for each frame of the shot.
        motion: its poses, one for each step.
        seconds: of each step since the first frame of the shot, shape (steps,).
    """

    shot: int
    first: int
    substeps: int
    motion: Motion
    seconds: Floats

    @property
    def frame_count(self) -> int:
        """Number of frames of the shot in this span."""
        return (self.motion.frame_count - 1) // self.substeps + 1


def split_into_spans(
    motion: Motion, skeleton: Skeleton, shot: int, fps: float, substeps: int, longest: int | None = None
) -> list[MotionSpan]:
    """Return the spans of a motion between its cuts, each at most `longest` frames of a shot at `fps`."""
    spans, first, source = [], 0, 0
    for part in split_at_cuts(motion, skeleton):
        stop = frames_at(source + part.frame_count, motion.fps, fps)
        most = longest or max(1, stop - first)
        for start in range(first, stop, most):
            count = (min(most, stop - start) - 1) * substeps + 1
            position = (start + np.arange(count) / substeps) * motion.fps / fps - source
            position = position.clip(0, part.frame_count - 1)
            poses, shapes = sample_motion(part, position), sample_shapes(part, position)
            seconds = (source + position) / motion.fps
            sampled = Motion(motion.path, fps * substeps, *poses, **shapes)
            spans.append(MotionSpan(shot, start, substeps, sampled, seconds))
        first, source = stop, source + part.frame_count
    return spans


def join_spans(motion: Motion, spans: Sequence[MotionSpan]) -> Motion:
    """Return the motion of a shot from its spans, one pose per frame."""
    fps, substeps = spans[0].motion.fps / spans[0].substeps, spans[0].substeps
    parts = [span.motion for span in spans]
    rotations = np.concatenate([part.rotations[::substeps] for part in parts])
    translations = np.concatenate([part.translations[::substeps] for part in parts])
    weights = [part.shape_weights[::substeps] for part in parts if part.shape_weights is not None]
    shaped = {"shapes": motion.shapes, "shape_weights": np.concatenate(weights)} if weights else {}
    return Motion(motion.path, fps, rotations, translations, motion.start * fps / motion.fps, **shaped)


@dataclass(frozen=True, eq=False)
class PosedCharacters(Framed):
    """Posed characters, each relative to its own root.

    Attributes:
        root: position of the skeleton's hub [m], float64, shape (3, N).
        body: relative to the root.
        lbs: the garment under linear blend skinning, relative to the root, shape (V, 3, N).
        matrices: skinning matrices of the character's joints, relative to the root, shape (J, 3, 4, N).
        world: what surrounds them, or None where nothing does.
        moves: of the body's vertices in the bind pose by blendshapes of their shots [m], shape (B, 3, N); or None.
    """

    root: Tensor
    body: PosedBody
    lbs: Tensor
    matrices: Tensor
    world: PosedWorld | None = None
    moves: Tensor | None = None


class CharacterPoser:
    """Poses the character of a scene, and its garments under linear blend skinning.

    Args:
        scenes: of the garments, whose vertices follow each other, on one character.
        limbs: axes that loose cloth must not cross.
    """

    def __init__(
        self, scenes: Sequence[Scene], limbs: LimbAxes | None, device: torch.device, dtype: torch.dtype
    ) -> None:
        scene = scenes[0]
        self.skeleton, self.dtype = scene.character.skeleton, dtype
        joints = self.skeleton.joint_count
        self.body = CollisionBody(scene.character.merged_body(), joints, limbs=limbs, device=device)
        weights, points = (
            np.concatenate(rows)
            for rows in zip(*((each.lbs_skin.dense(joints), each.garment.mesh.points) for each in scenes))
        )
        self.weights = torch.as_tensor(weights, dtype=dtype, device=device)
        self.rest = torch.as_tensor(points, dtype=dtype, device=device)[:, :, None]
        self.starts = np.cumsum([0, *(body.mesh.vertex_count for body in scene.character.bodies)])

    def only(self, vertices: Ints) -> CharacterPoser:
        """Return a poser of the same character with some of the garment's vertices alone."""
        part, rows = copy.copy(self), torch.as_tensor(vertices, device=self.rest.device)
        part.weights, part.rest = self.weights[rows], self.rest[rows]
        return part

    def poses_at(self, places: Sequence[tuple[Motion, int]]) -> PosedCharacters:
        """Return the poses of motions, each at a frame of it."""
        rotations, translations = (
            np.stack([getattr(motion, name)[frame] for motion, frame in places])
            for name in ("rotations", "translations")
        )
        return self.pose(rotations, translations, self.moves((motion, slice(at, at + 1)) for motion, at in places))

    def moves(self, parts: Iterable[tuple[Motion, slice | Ints]]) -> Tensor | None:
        """Return by how much shapes move the body's vertices in the bind pose [m], shape (B, 3, N); None without any.

        Args:
            parts: motions, each with some of its frames, N in all.
        """
        parts = list(parts)
        if not any(motion.shapes for motion, _ in parts):
            return None
        found = []
        for motion, frames in parts:
            weights = motion.shape_weights
            rows = np.zeros((len(motion.rotations[frames]), 0)) if weights is None else weights[frames]
            found.append(self._moved(motion.shapes, torch.as_tensor(np.array(rows, dtype=np.float32))))
        return torch.cat(found, dim=-1).to(self.rest.device)

    def _moved(self, shapes: Sequence[BodyShape], weights: Tensor) -> Tensor:
        """Return the moves (B, 3, N) of shapes with weights (N, K)."""
        moved = torch.zeros(int(self.starts[-1]), 3, len(weights))
        for shape, course in zip(shapes, weights.T):
            if shape.body < len(self.starts) - 1 and course.any():  # no cloth meets stand-ins
                rows = torch.as_tensor(np.asarray(shape.rows) + self.starts[shape.body])
                moved[rows] += torch.as_tensor(np.array(shape.offsets, dtype=np.float32))[:, :, None] * course
        return moved

    def between(
        self, roots: Tensor, matrices: Tensor, poses: PosedCharacters, share: float, moves: Tensor | None = None
    ) -> PosedCharacters:
        """Return characters a share of the way from others to `poses`, each joint turned about its parent.

        Args:
            roots, matrices, moves: of the others, as in `PosedCharacters`.
        """
        ends = (self._local(*each) for each in ((roots, matrices), (poses.root, poses.matrices)))
        (turned, placed), (rotations, translations) = ends
        ways = [part * weight for part, weight in ((moves, 1 - share), (poses.moves, share)) if part is not None]
        moved = torch.stack(ways).sum(0) if ways else None
        placed = (1 - share) * placed + share * translations
        return self.pose(slerp(turned, rotations, np.asarray(share)), placed, moved)

    def _local(self, roots: Tensor, matrices: Tensor) -> tuple[Floats, Floats]:
        """Return the joints' local rotations (N, J, 4) and translations (N, J, 3) that `pose` takes."""
        skinning = np.broadcast_to(np.eye(4), (matrices.shape[-1], len(matrices), 4, 4)).copy()
        skinning[:, :, :3] = matrices.permute(3, 0, 1, 2).double().cpu().numpy()
        world = skinning @ self.skeleton.bind_transforms
        world[:, :, :3, 3] += roots.T.cpu().numpy()[:, None]
        local = local_transforms(world, self.skeleton.parents)
        return quaternion_from_matrix(local[..., :3, :3]), local[..., :3, 3]

    def pose(self, rotations: Floats, translations: Floats, moves: Tensor | None = None) -> PosedCharacters:
        """Return characters with local joint rotations (N, J, 4) and translations (N, J, 3), and bodies that are
        moved in the bind pose as `moves` says."""
        world = world_transforms(rigid(matrix_from_quaternion(rotations), translations), self.skeleton.parents)
        root = world[:, self.skeleton.hub, :3, 3].copy()
        world[:, :, :3, 3] -= root[:, None]
        matrices = skinning_matrices(world, self.skeleton.bind_transforms)[:, :, :3].transpose(1, 2, 3, 0)
        character = torch.as_tensor(matrices.copy(), dtype=self.dtype, device=self.rest.device)
        lbs = transform_points(blend_matrices(self.weights, character), self.rest)
        return PosedCharacters(
            torch.as_tensor(root.T.copy(), device=self.rest.device),
            self.body.pose(character.float(), exact=True, moves=moves),
            lbs,
            character,
            moves=moves,
        )
